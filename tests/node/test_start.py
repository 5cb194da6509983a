"""What a start loads: a client and `--help` wait for no numerics that they do not use."""

from __future__ import annotations

import subprocess
import sys

import pytest

HEAVY = {"numba", "llvmlite", "torch", "cv2", "open3d", "onnxruntime", "scipy", "pydantic", "matplotlib"}


def loaded(code: str) -> set[str]:
    """Packages that a fresh interpreter has loaded after this."""
    printing = f"import sys\n{code}\nprint(*{{name.partition('.')[0] for name in sys.modules}})"
    process = subprocess.run(
        [sys.executable, "-c", printing], capture_output=True, text=True, check=True, timeout=60
    )
    return set(process.stdout.splitlines()[-1].split())


def test_a_client_loads_nothing_that_maps() -> None:
    found = loaded("import sags_node.client")
    assert {"zmq", "numpy", "msgspec"} <= found
    assert not found & HEAVY


@pytest.mark.parametrize("asked", [["--help"], ["topic", "--help"], ["bag", "--help"]], ids=" ".join)
def test_help_loads_no_numerics(asked: list[str]) -> None:
    found = loaded(f"from sags_node.cli.main import main\nmain({asked}, standalone_mode=False)")
    assert "click" in found
    assert not found & (HEAVY | {"numpy"})
