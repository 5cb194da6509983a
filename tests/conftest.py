"""Sessions and folders that several tests share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from sags_node.config import PhantomSource
from sags_node.phantom import write_session

ROOT = Path(__file__).parent.parent


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
