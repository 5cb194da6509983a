"""Writes docs/dev/soup.md from an SBOM: `make release`.

What the product asks for itself has a row of its own: what for, and what if it is wrong. What these bring
along stands under them.
"""

import json
import sys
import tomllib
from pathlib import Path

from licences_page import ROOT, plain
from packaging.requirements import Requirement

PAGE = Path(__file__).with_name("soup.md")
HEAD = """# Software of unknown provenance

<!-- Written by `make release` from its SBOM and from docs/dev/soup_page.py. Change it there. -->

What an installation of `.[all]` runs that others wrote (SOUP: IEC 62304, 8.1.2). `make release` writes its
SBOM, `make audit` asks osv.dev what is known against each. Licences: [licences.md](licences.md). Python and
Debian's libraries come beside it.

| name | version | what for | what if it is wrong, and what notices |
|---|---|---|---|
"""
EXTRAS = ("node", "viewer", "report", "bridges")  # those of `all`
TWIN = "wrong images or depth; each kernel is compared with a readable twin"
GOLDEN = "wrong images or depth; golden replays repeat bit by bit"
LINE = "a wrong or no message"
USES = {
    "av": ("reads and writes videos (FFmpeg)", "wrong images or stamps; counts and stamps are checked"),
    "click": ("the command line", "a command does not run"),
    "foxglove-sdk": ("sags bridge foxglove", "that bridge alone"),
    "lz4": ("compression in bags", "a bag is not read; checksums"),
    "matplotlib": ("plots of reports", "a plot alone"),
    "mcap": ("bags", "a bag is not read; damaged ones are recovered"),
    "msgspec": ("the metadata of each message", f"{LINE}; checked against C++ and C# clients"),
    "numba": ("compiles the kernels", TWIN),
    "numpy": ("arrays", GOLDEN),
    "onnxruntime": ("runs networks of the user", "wrong depth or masks; of NaN the matcher takes over"),
    "open3d": ("surfaces that are exported, registered, rendered", "a wrong mesh; compared with exact truth"),
    "opencv-contrib-python-headless": ("rectification, flow, images as files", GOLDEN),
    "pillow": ("the first look at images as files", "an image is refused"),
    "pydantic": ("launch files", "a wrong key is taken; each limit has a test"),
    "pyigtl": ("sags bridge openigtlink", "that bridge alone"),
    "pyyaml": ("launch, scene and calibration files", "a wrong value; only safe_load, and fuzzed"),
    "pyzmq": ("the sockets (ZeroMQ, CURVE)", f"{LINE}: content becomes stale; a hole lets strangers in"),
    "rich": ("tables on a terminal", "a table alone"),
    "rosbags": ("ROS messages", f"{LINE}; a second reader in the tests"),
    "torch": ("fits, and the paper's model live", TWIN),
    "viser": ("sags view", "the viewer alone; it is a process of its own"),
    "websockets": ("sags bridge web", "that bridge alone"),
    "zstandard": ("compression in bags", "a bag is not read; checksums"),
}  # fmt: skip


def page(sbom: Path) -> str:
    """The whole page.

    Raises:
        SystemExit: a package that the product asks for has no row in `USES`.
    """
    said = json.loads(sbom.read_text("utf-8"))
    found = {plain(one["name"]): one.get("version", "") for one in said["components"]}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    extras = [project["optional-dependencies"][extra] for extra in EXTRAS]
    asked = {plain(Requirement(text).name) for texts in (project["dependencies"], *extras) for text in texts}
    if missing := asked - USES.keys():
        sys.exit(f"docs/dev/soup_page.py says nothing of {', '.join(sorted(missing))}")
    rows = [f"| {name} | {found[name]} | {' | '.join(USES[name])} |" for name in sorted(asked)]
    rest = ", ".join(f"{name} {found[name]}" for name in sorted(found.keys() - asked))
    return f"{HEAD}{chr(10).join(rows)}\n\nBrought along by these, {len(found) - len(asked)}: {rest}.\n"


if __name__ == "__main__":
    PAGE.write_text(page(Path(sys.argv[1])), encoding="utf-8")
