# `make run` and `make test` do all set-up on a fresh Debian machine with Python 3.11.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/pip install -q --disable-pip-version-check -c constraints.txt
STAMP := $(VENV)/.installed
# Shared libraries that Open3D needs and its wheel does not bring.
DEBIAN := libusb-1.0-0 libgl1 libegl1 libgomp1 libx11-6 libidn2-0
# What tests use beyond that: a browser for the viewer and the web gateway, compilers for the C++ and C# clients
# and OpenIGTLink's peers, two machines in one, GStreamer.
DEBIAN_TESTS := chromium g++ cmake pkg-config cppzmq-dev libmsgpack-cxx-dev faketime iproute2 \
  libopenigtlink-dev openigtlink-examples \
  mono-mcs mono-runtime libmono-system-runtime-serialization4.0-cil \
  gstreamer1.0-tools gstreamer1.0-plugins-base gstreamer1.0-plugins-good gstreamer1.0-plugins-bad \
  gstreamer1.0-libav libgstrtspserver-1.0-0
# Tests start a hundred processes: without bytecode each would compile all that it imports, for 1.5 s.
unexport PYTHONDONTWRITEBYTECODE
missing = $(shell for p in $(1); do dpkg -s $$p >/dev/null 2>&1 || echo $$p; done)
apt_install = apt-get update -qq && apt-get install -y -qq --no-install-recommends $(1) >/dev/null

.PHONY: setup run test test-all bench gpu-check test-targets test-tools simulate stops soak fuzz wheel-test sbom release audit licences lint golden docs check-docs clean

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@if [ -n "$(call missing,$(DEBIAN))" ]; then \
	  if [ "$$(id -u)" = 0 ]; then $(call apt_install,$(call missing,$(DEBIAN))); \
	  else echo "Open3D needs Debian packages; run this once, then make again:"; \
	       echo "  sudo apt-get install --no-install-recommends $(call missing,$(DEBIAN))"; exit 1; fi; fi
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Python 3.11 or newer is needed: make PYTHON=/path/to/python3.11"; exit 1; }
	@echo "Installing Python packages into $(VENV): a minute or two, by the network"
	@$(PYTHON) -m venv $(VENV)
	@$(PIP) uv
	@# torch for the card that is there, or for the CPU. uv takes a fifth of pip's time; it does not know pip's
	@# configuration, so where it fails pip goes on.
	@$(BIN)/uv pip install -q --python $(BIN)/python -c constraints.txt --torch-backend auto torch 2>/dev/null || \
	  { echo "uv could not get torch for this machine; pip takes its own, which may bring CUDA: 4 GB"; $(PIP) torch; }
	@$(BIN)/uv pip install -q --python $(BIN)/python -c constraints.txt -e '.[dev]' || \
	  { echo "uv could not; pip goes on"; $(PIP) -e '.[dev]'; }
	@touch $@

# A live session of the built-in phantom, published and consumed over real sockets, and a report in out/demo.
run: setup
	$(BIN)/sags demo

# What must pass before a change goes in. What has sockets and clocks waits a lot, so three such files run at a time.
test: setup test-tools lint
	$(BIN)/python -m pytest -m 'not live and not beside' -n 2 --dist worksteal
	$(BIN)/python -m pytest -m 'live and not beside and not alone' -n 3 --dist loadfile

# What `make test` leaves out: benchmarks, sags_lab, clients in C++ and C#, and what needs the
# machine for itself.
test-all: setup test-tools
	$(BIN)/python -m pytest -m 'beside and not alone' -n 2 --dist loadfile
	$(BIN)/python -m pytest -m alone

# Run time against error on this machine, and its plot: out/pareto.json and out/pareto.png. LAUNCH: other recordings.
bench: setup
	$(BIN)/python -m benchmarks pareto $(LAUNCH) --frames 40 --out out/pareto.json --plot out/pareto.png --force

# All that a GPU should do, on a machine that has one: eight minutes. It takes .venv, else $(PYTHON), which needs the
# wheels of the extras node and gpu, torch with CUDA, and not Open3D. ARGS="--device cpu --small": without a GPU.
gpu-check:
	$(firstword $(wildcard $(BIN)/python) $(PYTHON)) -m benchmarks gpu --out out/gpu.json $(ARGS)

# The kernels' tests for other processors than this one, on one and on two threads: a quarter of an hour.
test-targets: setup
	$(BIN)/python tests/targets.py

# A node on a virtual clock with seeded faults: SEEDS="count first".
SEEDS ?= 5000
simulate: setup
	PYTHONPATH=tests/helpers $(BIN)/python tests/node/test_simulation.py $(SEEDS)

# A node's start broken off at COUNT moments: a quarter of an hour.
COUNT ?= 200
stops: setup
	PYTHONPATH=tests/helpers $(BIN)/python tests/node/test_stops.py $(COUNT)

# A live node with all its neighbours, ten minutes: does anything grow?
soak: setup
	$(BIN)/python -m benchmarks soak --check --out out/soak.json

# Damaged bytes for every reader, for so long; inputs that fail are kept in out/fuzz. GUIDED=1: changed so that
# they reach new lines, by atheris.
MINUTES ?= 60
fuzz: setup
	PYTHONPATH=tests/helpers $(BIN)/python tests/$(if $(GUIDED),guided_fuzz,test_fuzz).py $(MINUTES)

# Tests whose tools are missing are skipped, and say so.
test-tools:
	@if [ -n "$(call missing,$(DEBIAN_TESTS))" ]; then \
	  if [ "$$(id -u)" = 0 ]; then $(call apt_install,$(call missing,$(DEBIAN_TESTS))) || true; \
	  else echo "Some tests will be skipped without: sudo apt-get install $(call missing,$(DEBIAN_TESTS))"; fi; fi

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Rewrite the golden results of replay/ and print what changed.
golden: setup
	$(BIN)/python -m pytest tests/evaluation/test_replay.py --update-golden -s

# Rewrite what is made: docs/launch.md from the configuration, docs/dev/faults.md from the tests' marks, tables of figures
# in README.md and other pages from benchmarks/results.
docs: setup
	$(BIN)/python docs/dev/launch_page.py
	$(BIN)/python docs/dev/faults_page.py
	$(BIN)/python docs/dev/figures_page.py

# All that is stale at once: in documents, then layers, imports that a folder names, budgets of lines.
check-docs: setup
	@status=0; $(BIN)/python docs/dev/check_docs.py || status=1; \
	$(BIN)/python -m pytest tests/test_layers.py --tb=line || status=1; exit $$status

# The wheel in an empty environment, and its demo: some minutes, 3 GB in out/wheel.
wheel-test: setup
	$(BIN)/python tests/wheel.py

# What that environment holds, as CycloneDX: out/sbom.json.
sbom: wheel-test
	$(PYTHON) -m venv out/tools && out/tools/bin/pip install -q --disable-pip-version-check cyclonedx-bom
	out/tools/bin/cyclonedx-py environment --pyproject pyproject.toml -o out/sbom.json out/wheel/venv

# What is given away, in out/release: the wheel that was tried, the sdist, what it runs with, and their hashes.
release: sbom
	rm -rf out/release && mkdir out/release
	out/tools/bin/pip install -q --disable-pip-version-check build twine packaging
	cp out/wheel/sags_node-*.whl out/sbom.json out/release
	out/tools/bin/python -m build -q --sdist --outdir out/release .
	out/tools/bin/twine check --strict out/release/sags_node-*
	$(BIN)/python tests/wheel.py out/release/sags_node-*.tar.gz
	out/wheel/venv/bin/pip check
	out/tools/bin/python docs/dev/soup_page.py out/release/sbom.json
	cd out/release && sha256sum * > SHA256SUMS && cat SHA256SUMS

# Whether osv.dev knows a vulnerability of what that environment holds.
audit: wheel-test
	$(PYTHON) -m venv out/tools && out/tools/bin/pip install -q --disable-pip-version-check pip-audit
	out/wheel/venv/bin/pip freeze --exclude sags-node | sed 's/+.*//' > out/installed.txt
	out/tools/bin/pip-audit -s osv --strict --no-deps --disable-pip -r out/installed.txt

# Rewrite docs/dev/licences.md from the packages that are installed here.
licences: setup
	$(BIN)/python docs/dev/licences_page.py

clean:
	rm -rf $(VENV) out build *.egg-info .pytest_cache .mypy_cache .ruff_cache
