"""Damaged bytes for each reader as in `test_fuzz.py`, changed so that they reach new lines: by atheris.

`make fuzz MINUTES=60 GUIDED=1`. Each reader has a process of its own, which its fault ends. The input is kept
in `out/fuzz`. What libraries in C do is not seen by the guidance, only by the checks.
"""

import logging
import re
import subprocess
import sys
import tempfile
from pathlib import Path

KEPT = Path("out/fuzz")
ROOM = 60.0  # s, for a reader's start and its last input
# Kernels are compiled from the bytecode, so it must stay as it is there.
INSTRUMENTED = ["bags", "clients", "config", "messaging", "sources", "tools.calibration"]


def guide(name: str, seconds: float, folder: Path) -> None:
    """Fuzz one reader; does not return."""
    import atheris

    with atheris.instrument_imports(include=[f"sags_node.{one}" for one in INSTRUMENTED]):
        from fuzzing import TARGETS, bounded_memory
    logging.disable()
    target = TARGETS[name]
    for made in ("sound", "corpus"):
        (folder / made).mkdir()
    for number, whole in enumerate(target.sound(folder / "sound")):
        (folder / "corpus" / str(number)).write_bytes(whole)
    KEPT.mkdir(parents=True, exist_ok=True)
    prefix = f"-artifact_prefix={KEPT}/{name.replace(' ', '_')}_"
    # The time limit of an input is ours: two would take each other's alarm.
    limits = [f"-max_total_time={seconds:.0f}", "-timeout=0", "-handle_alrm=0", "-rss_limit_mb=0"]
    with bounded_memory():
        atheris.Setup(
            [sys.argv[0], *limits, prefix, "-max_len=65536", str(folder / "corpus")],
            lambda data: target.try_out(data, folder / "it"),
        )
        atheris.Fuzz()


def main(minutes: float, *names: str) -> int:
    """Fuzz all readers, one after the other; how many faults were found."""
    from fuzzing import TARGETS

    total, found = 0, 0
    chosen = names or tuple(TARGETS)
    for name in chosen:
        seconds = 60 * minutes / len(chosen)
        with tempfile.TemporaryDirectory() as folder:
            done = subprocess.run(
                [sys.executable, __file__, "--one", name, str(seconds), folder],
                stderr=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                timeout=seconds + ROOM,
                check=False,
            )
        said = done.stderr.decode(errors="replace")
        counts = re.findall(r"^(?:Done |#)(\d+)", said, re.MULTILINE)
        runs = max(map(int, counts), default=0)
        total += runs
        print(f"{name:20} {runs:9,} inputs{'' if done.returncode == 0 else ', FAILED'}", flush=True)
        if done.returncode != 0:
            found += 1
            print("\n".join(said.splitlines()[-30:]), flush=True)
    print(f"{total:,} inputs, {found} faults")
    return found


if __name__ == "__main__":
    if sys.argv[1] == "--one":
        guide(sys.argv[2], float(sys.argv[3]), Path(sys.argv[4]))
    sys.exit(min(1, main(float(sys.argv[1]), *sys.argv[2:])))
