# `make run` and `make test` do all set-up on a fresh Debian machine with Python 3.11.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# Shared libraries that Open3D needs and its wheel does not bring.
DEBIAN := libusb-1.0-0 libgl1 libegl1 libgomp1 libx11-6

.PHONY: setup run test lint golden clean

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@missing=""; for p in $(DEBIAN); do dpkg -s $$p >/dev/null 2>&1 || missing="$$missing $$p"; done; \
	if [ -n "$$missing" ]; then \
	  if [ "$$(id -u)" = 0 ]; then apt-get update -qq && apt-get install -y -qq --no-install-recommends $$missing >/dev/null; \
	  else echo "Open3D needs Debian packages; run this once, then make again:"; \
	       echo "  sudo apt-get install --no-install-recommends$$missing"; exit 1; fi; fi
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Python 3.11 or newer is needed: make PYTHON=/path/to/python3.11"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install -q --disable-pip-version-check -c constraints.txt torch
	$(BIN)/pip install -q --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

# A live session of the built-in phantom, published and consumed over real sockets, and a report in out/demo.
run: setup
	$(BIN)/sags demo

test: setup lint
	$(BIN)/python -m pytest

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Rewrite the golden results of replay/ and print what changed.
golden: setup
	$(BIN)/python -m pytest tests/test_replay.py --update-golden -s

clean:
	rm -rf $(VENV) out build *.egg-info .pytest_cache .mypy_cache .ruff_cache
