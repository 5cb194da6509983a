from __future__ import annotations

from pathlib import Path

import pytest
from tiny_archive import write_tiny_session


@pytest.fixture(scope="session")
def tiny_session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tiny") / "session"
    write_tiny_session(folder, seed=1)
    return folder
