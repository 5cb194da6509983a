"""What strangers give: no reader of it ends in anything but values or one line of ours.

A few hundred inputs each here; `make fuzz MINUTES=60` goes on for as long as it is told, with other inputs
each time, and keeps those that fail in `out/fuzz`. One that ends the process itself is the file `last` in the
newest temporary folder.
"""

import logging
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from fuzzing import IN_MEMORY, LONGEST, TARGETS, HungError, Target, bounded_memory, damaged
from hypothesis import HealthCheck, Phase, given, seed, settings

from sags_node.errors import SagsError

FILES = 40  # inputs of a reader of files, which take some milliseconds each
QUICK = 200  # of the others
FAILED_ONCE = {
    # A line of the header that is too long for a reader's buffer ended the process.
    "ply": lambda sound: sound[-1].replace(b"end_header", 250 * b"end_header"),
    "opencv calibration": lambda _: b"%YAML 1.2\n-\nM1: [ 1 ]\n",  # OpenCV looks for names in a list
}
AT_ONCE = 300  # inputs of one reader before the next one's turn


@pytest.fixture(autouse=True)
def bounded(caplog: pytest.LogCaptureFixture) -> Iterator[None]:
    caplog.set_level(logging.CRITICAL)
    with bounded_memory():
        yield


def fuzz(target: Target, inputs: int, number: int, folder: Path) -> Counter[bool]:
    """How many inputs were read, and how many refused.

    Raises:
        what a reader raised that it must not.
    """
    outcomes = Counter[bool]()
    (folder / "sound").mkdir(parents=True)
    sound = target.sound(folder / "sound")
    for whole in sound if len(sound) < 50 else []:
        outcomes[target.try_out(whole, folder / "it")] += 1

    @seed(number)
    @settings(
        max_examples=inputs, deadline=None, database=None, suppress_health_check=list(HealthCheck),
        phases=(Phase.generate, Phase.shrink), print_blob=False,
    )  # fmt: skip
    @given(damaged(sound))
    def one(data: bytes) -> None:
        (folder / "last").write_bytes(data)  # of those that fail the smallest is tried last
        outcomes[target.try_out(data, folder / "it")] += 1

    one()
    return outcomes


@pytest.mark.fault("file: a launch or calibration file is damaged")
@pytest.mark.fault("file: bits of a ROS bag are flipped")
@pytest.mark.parametrize("name", TARGETS)
def test_damaged_bytes_end_in_values_or_in_one_line(name: str, tmp_path: Path) -> None:
    outcomes = fuzz(TARGETS[name], QUICK if name in IN_MEMORY else FILES, 0, tmp_path)
    assert outcomes[True] > 0  # it gets past the first check
    assert outcomes[False] > 0 or name == "requests"  # which are answered, not refused


@pytest.mark.parametrize("name", FAILED_ONCE)
def test_what_once_failed(name: str, tmp_path: Path) -> None:
    target = TARGETS[name]
    (tmp_path / "sound").mkdir()
    target.try_out(FAILED_ONCE[name](target.sound(tmp_path / "sound")), tmp_path / "it")


def test_a_reader_that_fails_or_hangs_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fuzzing.LONGEST", 0.05)

    def traceback(data: bytes, _: Path) -> None:
        if data[:1] == b"\0":
            raise ValueError("no such thing")

    def two_lines(data: bytes, _: Path) -> None:
        raise SagsError("one\ntwo")

    def hang(data: bytes, _: Path) -> None:
        time.sleep(LONGEST)

    for use, error in ((traceback, ValueError), (two_lines, AssertionError), (hang, HungError)):
        with pytest.raises(error):
            fuzz(Target(lambda _: [b"sound"], use), QUICK, 0, tmp_path / use.__name__)


def main(minutes: float, *names: str) -> int:
    """Fuzz all readers in turn for so long; how many faults were found."""
    logging.disable()
    kept = Path("out/fuzz")
    began, inputs, found, number = time.monotonic(), Counter[str](), 0, time.time_ns() % 2**32
    targets = {name: TARGETS[name] for name in names or TARGETS}
    with bounded_memory():
        while time.monotonic() < began + 60 * minutes:
            number += 1
            for name, target in list(targets.items()):
                with tempfile.TemporaryDirectory() as folder:
                    try:
                        inputs[name] += fuzz(target, AT_ONCE, number, Path(folder)).total()
                    except BaseException as error:
                        if isinstance(error, KeyboardInterrupt):
                            raise
                        found += 1
                        del targets[name]  # it would find the same again
                        kept.mkdir(parents=True, exist_ok=True)
                        file = kept / f"{name.replace(' ', '_')}_{number}"
                        shutil.copy(Path(folder) / "last", file)
                        print(f"{name}: {type(error).__name__}: {str(error)[:300]}; kept: {file}", flush=True)
                if time.monotonic() > began + 60 * minutes:
                    break
    for name, count in inputs.items():
        print(f"{name:20} {count:9,} inputs")
    print(f"{inputs.total():,} inputs in {time.monotonic() - began:.0f} s, {found} faults")
    return found


if __name__ == "__main__":
    sys.exit(min(1, main(float(sys.argv[1]), *sys.argv[2:])))
