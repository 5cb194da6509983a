"""The wheel in an empty environment: it is built, installed with what it needs, and shows its demo.

`make wheel-test` takes some minutes and 3 GB in out/wheel, so it is none of the tests that always run. With
an sdist as its argument, as in `make release`, it looks whether that installs the same files as the wheel.
"""

import json
import os
import shutil
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

ROOT = Path(__file__).parent.parent
OUT = ROOT / "out/wheel"


def run(*command: object, folder: Path | None = None) -> str:
    """What a command says on stdout; it sees nothing of this repository but by its arguments."""
    environment = {
        name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")
    }
    done = subprocess.run(
        list(map(str, command)),
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
        timeout=1800,
        check=True,
    )
    return done.stdout


def main() -> None:
    shutil.rmtree(OUT, ignore_errors=True)
    home = OUT / "empty"
    home.mkdir(parents=True)
    pip = [sys.executable, "-m", "pip", "-q", "--disable-pip-version-check"]
    shutil.rmtree(ROOT / "build", ignore_errors=True)  # what was deleted since would be packed from there
    run(*pip, "wheel", "--no-deps", "-w", OUT, ROOT)
    (wheel,) = OUT.glob("sags_node-*.whl")
    with zipfile.ZipFile(wheel) as packed:
        names = {name for name in packed.namelist() if ".dist-info/" not in name}
    assert names == _files(ROOT), names ^ _files(ROOT)
    print(f"{wheel.name}: {wheel.stat().st_size / 1e6:.1f} MB, {len(names)} files", flush=True)

    sags = _installed(OUT / "client", str(wheel))
    light = OUT / "client/bin/python"
    brought = json.loads(run(light, "-m", "pip", "list", "--format", "json", "--disable-pip-version-check"))
    assert "torch" not in {each["name"] for each in brought}, brought
    run(light, "-c", "import sags_node.client", folder=home)
    refused = subprocess.run(
        [sags, "run"], check=False, cwd=home, stderr=subprocess.PIPE, text=True, timeout=60
    )
    assert refused.returncode == 2 and "'.[node]'" in refused.stderr, refused.stderr
    print(f"a client: {len(brought)} packages", flush=True)

    sags = _installed(OUT / "venv", f"{wheel}[all]")
    python = OUT / "venv/bin/python"
    where = run(python, "-c", "import sags_node; print(sags_node.__file__)", folder=home).strip()
    assert Path(where).is_relative_to(OUT), where
    print(run(sags, "--version", folder=home).strip(), flush=True)
    shown = json.loads(run(sags, "demo", "--json", "--seconds", 5, "--out", home / "demo", folder=home))
    assert shown["processed"] > 0 and shown["overlay"]["frames"] > 0, shown
    assert {"report.html", "overlay.mp4"} <= {file.name for file in (home / "demo").iterdir()}
    print(f"sags demo: {shown['processed']} frames, {shown['overlay']['frames']} of the overlay", flush=True)


def sdist(file: str) -> None:
    installed = [_installed(OUT / "sdist", file), OUT / "client/bin/sags"]
    of_sdist, of_wheel = (_files(*sags.parent.parent.glob("lib/python*/site-packages")) for sags in installed)
    assert of_sdist == of_wheel == _files(ROOT), of_sdist ^ of_wheel
    print("the sdist:", run(installed[0], "--version", folder=OUT / "empty").strip(), flush=True)


def _files(folder: Path) -> set[str]:
    """The files of our packages below a folder, but for compiled ones."""
    found = (each for name in ("sags_node", "sags_lab") for each in (folder / name).rglob("*.*"))
    return {str(each.relative_to(folder)) for each in found if "__pycache__" not in each.parts}


def _installed(folder: Path, what: str) -> Path:
    """The command `sags` of an environment of its own."""
    venv.create(folder, with_pip=True)
    pip = [folder / "bin/python", "-m", "pip", "-q", "--disable-pip-version-check"]
    run(*pip, "install", "-c", ROOT / "constraints.txt", what)
    return folder / "bin/sags"


if __name__ == "__main__":
    sdist(*sys.argv[1:]) if len(sys.argv) > 1 else main()
