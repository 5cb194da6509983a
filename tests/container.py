"""The steps of the Containerfile in an empty Debian, for machines that can run no container.

    python tests/container.py FOLDER [--torch-index URL] [--share PATH ...]

Needs root, debootstrap and unshare, some minutes, and 4 GB in FOLDER, which stays. The base is Debian's own
Python 3.11, not the image `python:3.11-slim-bookworm`. PATH: what pip reads here, as /etc/ssl/certs behind a
proxy. At the end the image's user plays `sags demo`.
"""

import argparse
import json
import os
import re
import shlex
import shutil
import subprocess
import time
from pathlib import Path

ROOT = Path(__file__).parent.parent
FILE = ROOT / "examples/container/Containerfile"
STAGES = ("base", "cpu")
BASE = "python3-pip,python3-venv,ca-certificates"  # what the image has, and Debian's smallest system has not
# pip's settings are those of this machine; Debian's refuses to install beside Debian's packages.
KEPT = {name: value for name, value in os.environ.items() if name.startswith(("PIP_", "SSL_"))}
KEPT |= {"PIP_BREAK_SYSTEM_PACKAGES": "1", "PATH": "/usr/local/bin:/usr/bin:/bin:/usr/sbin:/sbin"}


def steps(text: str) -> list[tuple[str, str]]:
    """Instructions and their arguments, in order, of `STAGES`."""
    lines = "\n".join(line for line in text.splitlines() if not line.startswith("#"))
    split = [line.partition(" ") for line in re.sub(r"\\\n\s*", " ", lines).splitlines() if line]
    found, wanted = [], False
    for word, _, rest in split:
        if word == "FROM":
            wanted = rest.rpartition(" AS ")[2] in STAGES
        elif wanted:
            found.append((word, rest))
    return found


class Box:
    """An empty Debian in a folder, in which instructions are carried out.

    Args:
        shared: folders of this machine that commands in it see, too.
    """

    def __init__(self, folder: Path, shared: list[Path]) -> None:
        self._folder, self._shared = folder, shared
        self._user, self._place, self.environment = "0", "/", dict(KEPT)

    def run(self, command: str) -> None:
        """Run a shell's command as the user and in the folder that were set."""
        root = shlex.quote(str(self._folder))
        mounts = [f"mount --rbind /dev {root}/dev", f"mount -t proc proc {root}/proc"]
        for path in self._shared:
            mounts.append(f"mkdir -p {root}{path} && mount --bind {path} {root}{path}")
        inside = shlex.quote(f"cd {self._place} && {command}")
        enter = f"exec chroot --userspec={self._user} {root} /bin/sh -ec {inside}"
        words = ["unshare", "--mount", "--pid", "--fork", "sh", "-ec", " && ".join([*mounts, enter])]
        home = "/root" if self._user == "0" else "/var/lib/sags"
        subprocess.run(words, env=self.environment | {"HOME": home}, check=True, timeout=1800)

    def take(self, word: str, rest: str) -> None:
        """Do what an instruction says."""
        place = self._folder / self._place.lstrip("/")
        if word == "RUN":
            self.run(rest)
        elif word == "COPY":
            *given, where = rest.split()
            for name in given:
                if (ROOT / name).is_dir():
                    shutil.copytree(ROOT / name, place / where, ignore=shutil.ignore_patterns("__pycache__"))
                else:
                    shutil.copy(ROOT / name, place / where)
        elif word in ("ENV", "ARG"):
            given = dict(part.split("=", 1) for part in shlex.split(rest))
            self.environment |= given if word == "ENV" else given | self.environment
        elif word == "WORKDIR":
            self._place = rest
            (self._folder / rest.lstrip("/")).mkdir(parents=True, exist_ok=True)
        elif word == "USER":
            self._user = rest


def main() -> None:
    asked = argparse.ArgumentParser()
    asked.add_argument("folder", type=Path)
    asked.add_argument("--torch-index", help="instead of the Containerfile's")
    asked.add_argument("--share", type=Path, action="append", default=[], help="a folder that pip reads")
    given = asked.parse_args()
    folder, began = given.folder.resolve(), time.monotonic()
    base = ["debootstrap", "--variant=minbase", f"--include={BASE}", "bookworm", folder]
    subprocess.run(base, check=True, stdout=subprocess.DEVNULL)
    shutil.copy("/etc/resolv.conf", folder / "etc/resolv.conf")
    box = Box(folder, given.share)
    if given.torch_index is not None:
        box.environment["TORCH_INDEX"] = given.torch_index
    taken = dict[str, str]()
    for word, rest in [("base", ""), *steps(FILE.read_text(encoding="utf-8"))]:
        box.take(word, rest)
        taken[word] = rest
        if word in ("base", "RUN"):
            passed, began = time.monotonic() - began, time.monotonic()
            size = subprocess.check_output(["du", "-sxm", folder], text=True).split()[0]
            print(f"{passed:5.0f} s, then {size} MB: {word} {rest[:60]}", flush=True)
    sags = shlex.join(json.loads(taken["ENTRYPOINT"]))
    box.run(f"{sags} doctor && {sags} demo --seconds 5")
    print(f"{time.monotonic() - began:5.0f} s: doctor and demo", flush=True)


if __name__ == "__main__":
    main()
