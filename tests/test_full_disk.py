"""Whatever is written, a full disk is one line and exit code 1, and nothing half written stays."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import refused, sags
from engine_scenes import camera, random_gaussians
from places import ROOT
from small_disk import fill, small_disk
from tiny_archive import write_tiny_session

from sags_lab.lerobot.dataset import merge
from sags_node.cli.launching import write_json
from sags_node.clients.overlay.save import Output
from sags_node.errors import SagsError
from sags_node.model.ply import write_ply
from sags_node.rig.hand_eye import HandEye, save_hand_eye
from sags_node.tools.fitting import start

DISK = 400 << 10  # bytes
NO_SPACE = "No space left on device"
SMALL = ("mapping.iterations:=1", "mapping.max_gaussians:=1000", "source.frames:=4")


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    with small_disk(tmp_path / "disk", DISK) as folder:
        yield folder


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of six frames."""
    folder = tmp_path_factory.mktemp("tiny") / "session"
    write_tiny_session(folder, seed=0)
    return folder


def there(folder: Path) -> set[str]:
    """All files, and folders that hold none."""
    below = [path for path in folder.rglob("*") if not path.is_dir() or not any(path.iterdir())]
    return {str(path.relative_to(folder)) for path in below} - {"filler"}


COMMANDS = {  # name -> arguments, TINY is the recording; bytes that are free, too few
    "splats": ("export --session TINY --splats DISK/x.ply", 8192),
    "points as ply": ("export --session TINY --points DISK/x.ply", 65536),
    "mesh as ply": ("export --session TINY --mesh DISK/x.ply", 65536),
    "orbit": ("export --session TINY --orbit DISK/x.mp4 --orbit-seconds 3", 8192),
    "render": ("export --session TINY --render DISK/x.mp4", 4096),
    "depth": ("export --session TINY --depth DISK/depth", 65536),
    "tracks": ("export --session TINY --tracks DISK/x.npz", 0),
    "lerobot, a video": ("export --session TINY --lerobot DISK/set", 4096),
    "lerobot, its table": ("export --session TINY --lerobot DISK/set", 32768),
    "sequence": ("export --session TINY --sequence DISK/frames", 0),
    "eval's figures": ("eval TINY --pace step --out DISK/x.json", 0),
    "eval's page": ("eval TINY --pace step --report DISK/report", 8192),
    "fit": ("fit TINY --out DISK/fit --iterations 1 --max-gaussians 1000", 65536),
    "phantom": ("phantom DISK/new seconds:=1 width:=160 height:=128", 65536),
    "calib convert": (f"calib convert {ROOT / 'calib/d4d'} -o DISK/rig", 0),
    "calib live": ("calib live TINY --seconds 0.1 -o DISK/eyes.png", 8192),
    "keygen": ("keygen node --out DISK/keys", 0),
    "archive scan": ("archive scan TINY --out DISK/x.csv", 0),
    "foxglove's layout": ("bridge foxglove --layout DISK/x.json", 0),
}
PLAYS = ("export", "eval", "fit")


@pytest.mark.fault("disk: full while anything is written")
@pytest.mark.usefixtures("run_dir")
@pytest.mark.parametrize("name", COMMANDS)
def test_a_full_disk_is_one_line_and_leaves_nothing_half_written(
    disk: Path, tiny: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(start, "PATH_STEPS", 1)  # how good a fit is does not matter here
    command, left = COMMANDS[name]
    arguments = [word.replace("TINY", str(tiny)).replace("DISK", str(disk)) for word in command.split()]
    fill(disk, left)
    result = sags(*arguments, *(SMALL if arguments[0] in PLAYS else ()))
    assert result.exit_code == 1, result.output
    said = result.stderr.splitlines()
    assert [NO_SPACE in line for line in said if "error: cannot write" in line] == [True], said
    assert str(disk) in said[-1] and ".sags-" not in said[-1]
    assert there(disk) <= {"depth", "set", "report", "fit", "frames", "rig", "keys", "fit/test"}  # empty ones


@pytest.mark.usefixtures("run_dir")
def test_what_stood_there_stays(disk: Path, tiny: Path) -> None:
    (disk / "x.ply").write_text("mine")
    (disk / "x.json").write_text('{"provenance": "older"}')
    fill(disk, 0)
    session = ("export", tiny, *SMALL, "--force")
    refused(1, *session, "--mesh", disk / "x.ply", said=(NO_SPACE,))
    assert NO_SPACE in sags("eval", tiny, *SMALL, "--pace", "step", "--out", disk / "x.json").stderr
    assert (disk / "x.ply").read_text() == "mine" and "older" in (disk / "x.json").read_text()
    assert there(disk) == {"x.ply", "x.json"}


def shown(file: Path, frames: int) -> None:
    """What the overlay keeps."""
    output, rng = Output(file), np.random.default_rng(0)
    for _ in range(frames):
        output.add(rng.integers(0, 255, (256, 320, 3), np.uint8), True, 1 / 30)
    output.close()


def a_data_set(disk: Path) -> None:
    pytest.importorskip("pyarrow", reason="the extra archive is not installed")
    session, one = disk.parent / "session", disk.parent / "one"
    write_tiny_session(session, seed=0)
    assert sags("export", session, *SMALL, "--lerobot", one).exit_code == 0
    merge([one], disk / "all", "v3.0")


WRITERS: dict[str, Callable[[Path], Any]] = {
    "the node's model": lambda disk: write_ply(disk / "x.ply", random_gaussians(0, 1000, camera())),
    "the overlay's image": lambda disk: shown(disk / "x.png", 1),
    "the overlay's video": lambda disk: shown(disk / "x.mp4", 40),
    "a hand-eye calibration": lambda disk: save_hand_eye(HandEye(np.eye(4)), disk / "rig", {}),
    "a data set of many recordings": a_data_set,
    "a table": lambda disk: write_json(disk / "x.json", {}),
}


@pytest.mark.usefixtures("run_dir")
@pytest.mark.parametrize("name", WRITERS)
def test_a_writer_without_a_command_does_the_same(disk: Path, name: str) -> None:
    fill(disk, 0)
    with pytest.raises(SagsError, match=NO_SPACE):
        WRITERS[name](disk)
    assert there(disk) <= {"rig", "all"}


@pytest.mark.fault("disk: full while an overlay keeps its video")
def test_a_video_that_gets_no_more_is_told_of_at_once(disk: Path, caplog: pytest.LogCaptureFixture) -> None:
    fill(disk, 0)
    with pytest.raises(SagsError, match=NO_SPACE):
        shown(disk / "x.mp4", 40)
    assert caplog.messages == [f"{disk / 'x.mp4'} gets no more images: {NO_SPACE}; the overlay goes on"]


@pytest.mark.fault("disk: full while recording")
@pytest.mark.usefixtures("run_dir")
def test_a_recording_keeps_what_it_has(disk: Path, tiny: Path) -> None:
    """It cannot be made again: `sags bag recover` reads it, and finds no metadata.yaml that is cut off."""
    fill(disk, 100 << 10)
    said = ("bag", "record", "--session", tiny, *SMALL, "-o", disk / "bag")
    refused(1, *said, said=(NO_SPACE, f"sags bag recover {disk / 'bag'} -o OUT"))
    assert there(disk) == {"bag/bag_0.mcap"} and (disk / "bag/bag_0.mcap").stat().st_size > 50_000
