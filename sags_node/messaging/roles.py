"""What a client may ask of the node, by the role of its key: the name of its `.pub` file's folder.

Every role may receive data. Each role may also do what those before it may.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

Role = Literal["listen", "control", "files"]
ROLES: tuple[Role, ...] = get_args(Role)
ALL: Role = "files"  # of keys in a folder of another name, and of everybody where there are no keys

_OPERATIONS: dict[Role, frozenset[str]] = {
    "listen": frozenset({"ping", "get_clock", "get_status", "get_health", "get_parameters", "measure"}),
    "control": frozenset(
        {"set_parameters", "reset_model", "pause", "resume", "add_anchor", "remove_anchor"}
        | {"open_view", "close_view", "start_strain", "stop_strain"}
    ),
    "files": frozenset({"save_model", "start_recording", "take_snapshot", "stop_recording"}),
}


@dataclass(frozen=True, slots=True)
class Client:
    """A client that has a key.

    Attributes:
        name: of the key's file.
    """

    name: str
    role: Role = ALL

    def __str__(self) -> str:
        return self.name if self.role == ALL else f"{self.name} ({self.role})"

    @property
    def rank(self) -> int:
        """The index of its role in `ROLES`: 0 may do the least."""
        return ROLES.index(self.role)

    def may(self, op: str) -> bool:
        return self.rank >= ROLES.index(needed(op))


def needed(op: str) -> Role:
    """The lowest role that may ask for an operation; the highest for one that is not listed."""
    return next((role for role in ROLES if op in _OPERATIONS[role]), ALL)


def client_of(file: Path) -> Client:
    """The client whose key is in a `.pub` file, with the role by the file's folder."""
    folder = file.absolute().parent.name.lower()
    return Client(file.stem, next((role for role in ROLES if role == folder), ALL))
