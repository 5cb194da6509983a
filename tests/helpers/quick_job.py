"""Stands in for a job where what schedules jobs is tested. Its recordings are text files that say what
happens to them; it is run as `sags eval RECORDING ...` would be."""

import json
import os
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path


def main() -> None:
    recording = next(Path(each) for each in sys.argv[2:] if each.endswith(".json"))
    report = Path(sys.argv[sys.argv.index("--report") + 1])
    said = json.loads(recording.read_text())
    report.mkdir()
    if "signs" in said:  # that it began
        (Path(said["signs"]) / f"{recording.stem}.{os.getpid()}").touch()
    if said.get("waits_for"):
        deadline = time.monotonic() + 60
        while not Path(said["waits_for"]).exists() and time.monotonic() < deadline:
            time.sleep(0.05)
    time.sleep(said.get("seconds") or 0)
    if said.get("takes_memory"):
        held = bytearray(os.urandom(1 << 20)) * said["takes_memory"]
        time.sleep(60)
        del held
    if said.get("writes"):
        write_large(report / "large", said["writes"] << 20)
    if said.get("signal"):
        os.kill(os.getpid(), signal.Signals[said["signal"]])
    if said.get("fails"):
        print(f"error: {said['fails']}", file=sys.stderr)
        sys.exit(said.get("code", 1))
    (report / "content").write_text(recording.stem)
    figures = {"frames": 3, "online": {"psnr": said["psnr"]}, "warnings": {}}
    told = {"threads": os.environ["OMP_NUM_THREADS"], "gpu": os.environ.get("CUDA_VISIBLE_DEVICES")}
    print(json.dumps(figures | told | {"played": str(recording)}))


def write_large(file: Path, size: int) -> None:
    """As `sags` writes: in a line it is said that the disk is full, and it is not full any more."""
    try:
        file.write_bytes(bytes(size))
    except OSError as error:
        with suppress(OSError):
            print(f"error: {error.strerror}", file=sys.stderr, flush=True)
        file.unlink()
        sys.exit(1)


if __name__ == "__main__":
    main()
