"""The results of the checks made before anything plays: ok, warning or error, each with its fix.

The warnings of a running node are in `findings`.
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
    """The result of one check."""

    level: Level
    what: str
    fix: str = ""
    figures: Mapping[str, float] = field(default_factory=dict)  # what was measured, for programs
    launch: tuple[str, ...] = ()  # `key:=value` that fix it


def is_wrong(found: Iterable[Finding]) -> bool:
    """Tell whether one of the findings is an error."""
    return any(each.level == "error" for each in found)


def as_warnings(found: Iterable[Finding]) -> list[Finding]:
    """Return the findings with errors lowered to warnings, for something that is played all the same."""
    return [replace(each, level="warning") if each.level == "error" else each for each in found]


def refuse_errors(found: Iterable[Finding], where: object) -> None:
    """Raise one error that lists all findings of level error; `where` names what was checked.

    Raises:
        UsageError: there is such a finding.
    """
    errors = [f"{where}: {each.what}; {each.fix}" for each in found if each.level == "error"]
    if errors:
        raise UsageError("\n".join(errors))


def parted(level: Level, message: str, otherwise: str = "") -> Finding:
    """Split a message "what is wrong; how to fix it" into a finding, at the first semicolon that is not part
    of an existing file's name. `otherwise` is the fix where the message has none."""
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
    """The finding for an error that was raised while a file was checked."""
    found = parted("error", str(error), "fix or remove that file")
    return replace(found, what=f"{what}: {found.what}")
