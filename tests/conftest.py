"""Sessions and folders that several tests share."""

import fcntl
import os
import signal
from pathlib import Path

import pytest

import sags_node.kernels.threads  # noqa: F401 - before torch: it says how idle workers wait, here as in a node
from sags_node.config.schema import FoldersSource, LaunchConfig, PhantomSource
from sags_node.phantom import write_session

ROOT = Path(__file__).parent.parent


def pytest_configure(config: pytest.Config) -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)  # else children ignore it beside `&` in a script
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # and this one under nohup

    if config.getoption("numprocesses", None):  # this starts the workers: each would compile what is not kept
        from sags_node.pipeline.warm_up import warm_up

        warm_up(LaunchConfig())


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what is `beside` the node by its place."""
    for item in items:
        folder = item.path.relative_to(ROOT / "tests").parts[0]
        if folder in ("benchmarks", "lab"):
            item.add_marker("beside")


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """Where the real recordings lie; a test that needs them skips where they are not."""
    folder = Path(os.environ.get("SAGS_DATA", ROOT / "../shared/data")).resolve()
    if not folder.is_dir():
        pytest.skip(f"real recordings are not here ({folder}); set SAGS_DATA to test with them")
    return folder


@pytest.fixture(scope="session")
def phantom_session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Forty frames of the phantom at a small size, with their truth; one worker renders them for all."""
    own = tmp_path_factory.getbasetemp()
    shared = own.parent if "PYTEST_XDIST_WORKER" in os.environ else own
    folder = shared / "phantom"
    with (shared / "phantom.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            write_session(PhantomSource(seconds=4.0, width=320, height=256, seed=1), folder, rate=10.0)
    return folder


@pytest.fixture(scope="session")
def plane_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sound recording of some ten chunks."""
    from recorded_plane import record_plane

    path, _ = record_plane(tmp_path_factory.mktemp("plane"), seconds=2.0)
    return path


@pytest.fixture
def folders(tmp_path: Path) -> FoldersSource:
    """Twelve pairs whose numbers are not padded: plain text order would play 1, 10, 11, 2."""
    from numbered_pictures import picture, write_png

    for number in range(12):
        write_png(tmp_path / f"left/L{number}.png", picture(number))
        write_png(tmp_path / f"right/R{number}.png", picture(number, eye=1))
    return FoldersSource(left=tmp_path / "left", right=tmp_path / "right", pace="step", rate=20)


@pytest.fixture
def run_dir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where nodes of this test would leave their files, away from a node that may run on this machine."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path / "sags"


@pytest.fixture(scope="session")
def user_files(phantom_session: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of `user_files.write_user_files`."""
    from user_files import write_user_files

    folder = tmp_path_factory.mktemp("user")
    write_user_files(folder, phantom_session)
    return folder


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--update-golden", action="store_true", help="rewrite the golden results and print what changed"
    )
