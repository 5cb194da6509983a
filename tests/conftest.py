"""Sessions and folders that several tests share."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from sags_node.config import PhantomSource
from sags_node.phantom import write_session

ROOT = Path(__file__).parent.parent

if not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"  # read when a kernel is imported: they then run on the CPU


@pytest.fixture(scope="module")
def quick_interpreter() -> Iterator[None]:
    """Triton's interpreter prepares its language anew for every call of a function, which takes longer than
    all the rest: prepare it once."""
    if torch.cuda.is_available():
        yield
        return
    import triton.language as tl
    from triton.runtime import interpreter

    prepared = interpreter._patch_lang(tl.zeros.fn)
    with pytest.MonkeyPatch.context() as patch:
        function = interpreter.InterpretedFunction
        patch.setattr(function, "__call__", lambda self, *args, **names: self.rewrite()(*args, **names))
        yield
    prepared.restore()


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """Where the real recordings lie; a test that needs them skips where they are not."""
    folder = Path(os.environ.get("SAGS_DATA", ROOT / "../shared/data")).resolve()
    if not folder.is_dir():
        pytest.skip(f"real recordings are not here ({folder}); set SAGS_DATA to test with them")
    return folder


@pytest.fixture(scope="session")
def phantom_session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Forty frames of the phantom at a small size, with their truth."""
    folder = tmp_path_factory.mktemp("phantom") / "session"
    write_session(PhantomSource(seconds=4.0, width=320, height=256, seed=1), folder, rate=10.0)
    return folder


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--update-golden", action="store_true", help="rewrite the golden results and print what changed"
    )
