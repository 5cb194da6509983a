"""Writes docs/dev/licences.md: what the product needs, and under which licences it comes: `make licences`.

What is installed says it of itself (`importlib.metadata`); so the page has the versions of the machine where
it was written.
"""

import re
import tomllib
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, distribution, metadata
from pathlib import Path

from packaging.requirements import Requirement

PAGE = Path(__file__).with_name("licences.md")
ROOT = PAGE.parents[2]
NOT_SHIPPED = {"dev", "all"}  # extras for those who change the product, and of others
HEAD = """# Licences

<!-- Written by `make licences` from what is installed. Change nothing here. -->

Python packages that the product needs, directly or indirectly, with the licence that each states.
The product is under Apache-2.0 ([LICENSE](../../LICENSE)). "extra" names the extra of an
optional package: `pip install '.[EXTRA]'`. `make sbom` writes the contents of an installation
as CycloneDX.

| package | version | licence | extra |
|---|---|---|---|
"""


def packages() -> dict[str, set[str]]:
    """Each package that is needed, and the extras that bring it; none: it is always there."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    wanted = {"": project["dependencies"], **project["optional-dependencies"]}
    found: dict[str, set[str]] = {}
    for extra, requirements in wanted.items():
        if extra not in NOT_SHIPPED:
            for name in _closure(requirements):
                found.setdefault(name, set()).add(extra)
    return found


def _closure(requirements: list[str]) -> set[str]:
    """All that these need, as far as it is installed."""
    waiting, seen = [Requirement(text) for text in requirements], set[tuple[str, str]]()
    names = set()
    while waiting:
        one = waiting.pop()
        for extra in ("", *one.extras):
            key = (plain(one.name), extra)
            if key in seen or (one.marker is not None and not one.marker.evaluate({"extra": ""})):
                continue
            seen.add(key)
            try:
                needs = distribution(one.name).requires or []
            except PackageNotFoundError:
                continue
            names.add(plain(one.name))
            waiting += [need for need in map(Requirement, needs) if _applies(need, extra)]
    return names


def _applies(need: Requirement, extra: str) -> bool:
    if need.marker is None:
        return extra == ""
    applies = need.marker.evaluate({"extra": extra})
    need.marker = None
    return applies


def plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def licence(name: str) -> str:
    """As a package states it: the expression, or the classifiers, or the first line of the free text."""
    said = metadata(name)
    if "License-Expression" in said:
        return said["License-Expression"]
    classified = [
        line.rpartition(" :: ")[2] for line in said.get_all("Classifier") or [] if "License ::" in line
    ]
    named = [one for one in classified if one != "OSI Approved"]
    text = said["License"].strip().splitlines() if "License" in said else []
    return ", ".join(named) or (text[0][:60] if text else "not stated")


def page() -> str:
    return HEAD + "".join(_rows())


def _rows() -> Iterator[str]:
    for name, extras in sorted(packages().items()):
        said = "" if "" in extras else ", ".join(sorted(extras))
        yield f"| {name} | {metadata(name)['Version']} | {licence(name).replace('|', '/')} | {said} |\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
