"""What was looked at before anything plays: fine, odd or wrong, each with its fix.

A running node's warnings are another thing: `findings`.
"""

import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

from sags_node.errors import SagsError, UsageError

Level = Literal["ok", "warning", "error"]
_BEFORE_NAME, _BEHIND_NAME = re.compile(r"""[\s"'(=:]"""), re.compile(r"""[\s"'),:;/]""")


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at."""

    level: Level
    what: str
    fix: str = ""
    figures: Mapping[str, float] = field(default_factory=dict)  # what was measured, for programs
    launch: tuple[str, ...] = ()  # `key:=value` that fix it


def is_wrong(found: Iterable[Finding]) -> bool:
    """True where one of them is an error."""
    return any(each.level == "error" for each in found)


def as_warnings(found: Iterable[Finding]) -> list[Finding]:
    """The same, of something that is wrong, and yet is played."""
    return [replace(each, level="warning") if each.level == "error" else each for each in found]


def refuse_errors(found: Iterable[Finding], where: object) -> None:
    """Refuse what has errors; `where` names it.

    Raises:
        UsageError: there are some.
    """
    errors = [f"{where}: {each.what}; {each.fix}" for each in found if each.level == "error"]
    if errors:
        raise UsageError("\n".join(errors))


def parted(level: Level, message: str, otherwise: str = "") -> Finding:
    """The finding of a message, which says what is wrong, and after a semicolon how to fix it: the first one
    that is in no name of a file."""
    for found in re.finditer("; ", message):
        if not _is_in_a_name(message, *found.span()):
            return Finding(level, message[: found.start()], message[found.end() :] or otherwise)
    return Finding(level, message, otherwise)


def _is_in_a_name(message: str, start: int, end: int) -> bool:
    """Tell whether the name of a file or folder that exists spans this part of a message."""
    begins = [0, *(each.end() for each in _BEFORE_NAME.finditer(message, 0, start))]
    ends = [*(each.start() for each in _BEHIND_NAME.finditer(message, end + 1)), len(message)]
    return any(os.path.exists(message[first:last]) for first in begins for last in ends)


def refused(what: str, error: SagsError) -> Finding:
    """The finding of an error that was raised while looking at a file."""
    found = parted("error", str(error), "fix or remove that file")
    return replace(found, what=f"{what}: {found.what}")
