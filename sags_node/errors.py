"""Errors a person can act on. The command line prints them as they are, without a traceback."""

from reprlib import Repr


class SagsError(Exception):
    """Something failed: says what is wrong, where, and how to fix it. Exit code 1."""

    exit_code = 1


class UsageError(SagsError):
    """The request itself is wrong (a key, a path, an option). Exit code 2."""

    exit_code = 2


def install(extra: str) -> str:
    """How to get an extra of this package, in words."""
    return f"pip install '.[{extra}]' in a clone, or 'sags-node[{extra}]' from an index that has it"


def first_line(error: BaseException) -> str:
    """What another library's error says, on one line."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]


_LONGEST = 100  # characters of a value in a message
_repr = Repr()
_repr.maxstring = _repr.maxother = _LONGEST


def brief(value: object) -> str:
    """The `repr` of a value, cut for a message: what was given may be of any size."""
    said = _repr.repr(value)
    return said if len(said) <= _LONGEST else f"{said[: _LONGEST - 3]}..."
