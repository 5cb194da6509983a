"""The V4L2 source against a real kernel driver: Linux' `vivid` test cameras in an emulated machine.

`tests/vivid/prepare.sh` fetches the kernel once. The guest sees this machine's files read-only and runs this
very Python on them; it needs no rights here and takes some ten seconds.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from places import ROOT

pytestmark = [pytest.mark.live, pytest.mark.alone]

CACHE = Path(
    os.environ.get("SAGS_VIVID_CACHE")
    or Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "sags-vivid"
)
QEMU = "qemu-system-x86_64"
TIME_LIMIT_S = 240  # an emulated machine on a busy host is slow; it usually takes ten


@pytest.fixture(scope="module")
def guest() -> dict[str, Any]:
    """What guest_check.py found out."""
    if shutil.which(QEMU) is None:
        pytest.skip(f"{QEMU} is not installed; run tests/vivid/prepare.sh as root")
    if not (CACHE / "initramfs.gz").exists():
        pytest.skip(f"no guest kernel in {CACHE}; run tests/vivid/prepare.sh")
    boot = {
        "check_python": sys.executable,
        "check_script": ROOT / "tests/vivid/guest_check.py",
        "check_root": ROOT,
    }
    command = [QEMU, "-accel", "tcg,thread=multi", "-cpu", "Nehalem", "-smp", "2", "-m", "1024"]
    command += ["-nodefaults", "-display", "none", "-no-reboot", "-serial", "stdio"]
    command += ["-kernel", str(CACHE / "vmlinuz"), "-initrd", str(CACHE / "initramfs.gz")]
    command += ["-append", " ".join(["console=ttyS0 quiet panic=-1", *(f"{k}={v}" for k, v in boot.items())])]
    command += ["-virtfs", "local,path=/,mount_tag=host,security_model=none,readonly=on,multidevs=remap"]
    run = subprocess.run(
        command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=TIME_LIMIT_S, check=False
    )
    results = [line for line in run.stdout.splitlines() if line.startswith("RESULT ")]
    assert len(results) == 1, f"the guest gave no result:\n{run.stdout}\n{run.stderr}"
    found: dict[str, Any] = json.loads(results[0].removeprefix("RESULT "))
    return found


def test_two_cameras_give_pairs(guest: dict[str, Any]) -> None:
    pairs = guest["two"]
    assert (pairs["frames"], pairs["sizes"], pairs["rate"]) == (12, [[180, 320, 3]], 30)
    assert pairs["left_advances"] and pairs["right_advances"] and pairs["ids_advance"]
    assert pairs["largest_skew_ms"] <= 20
    assert 0 <= pairs["age_ms"] < 5000  # stamps are of this wall clock
    assert pairs["contrast"] > 20 and pairs["pictures_differ"]  # vivid's moving test image


def test_one_camera_side_by_side(guest: dict[str, Any]) -> None:
    halves = guest["side_by_side"]
    assert halves["frames"] == 6 and halves["sizes"] == [[360, 320, 3]]
    assert halves["largest_skew_ms"] == 0 and halves["left_advances"]


def test_another_size_and_a_missing_camera_are_said(guest: dict[str, Any]) -> None:
    assert "/dev/video0: wanted 333x217 px, the driver gives 320x180" in guest["wrong_size"]
    assert "source.width" in guest["wrong_size"]
    assert guest["missing"] == "camera /dev/video7 does not exist; present: /dev/video0, /dev/video1"


def test_unplugged_cameras_are_opened_again(guest: dict[str, Any]) -> None:
    replug = guest["replug"]
    assert replug["vanished"] and replug["before"] >= 3 and replug["ended"]
    assert replug["after"] >= replug["before"] + 3
