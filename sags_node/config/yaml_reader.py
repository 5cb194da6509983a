"""The one reader of YAML that others wrote.

It returns what `yaml.safe_load` returns, and refuses what that takes in silence: keys that are given twice;
aliases that contain themselves or unfold to far more than was written; zero characters, which no file name
can hold, and texts that are no valid UTF-8. Octal numbers stay text, as they were written: `safe_load` makes
64 of 000100, but a text of 000180.
"""

import re
from pathlib import Path
from typing import Any

import yaml
from yaml.constructor import ConstructorError

from sags_node.errors import UsageError, brief
from sags_node.files import NO_TEXT, is_text, near, read_file

LARGEST_FILE = 1 << 20  # bytes
MOST_VALUES = 100_000  # with all aliases unfolded
LONGEST = 200  # characters of what PyYAML says
_INT, _TEXT = "tag:yaml.org,2002:int", "tag:yaml.org,2002:str"
_OCTAL = re.compile("[-+]?0[0_]*[1-7][0-7_]+")  # octal, and not the same number in decimal
EMPTY = {"", "~", "null", "Null", "NULL"}  # as YAML writes None


def read_yaml(file: Path, what: str, largest: int = LARGEST_FILE) -> Any:
    """Read the content of a YAML file.

    Args:
        what: what the file is meant to be, for the message, e.g. "launch file".
        largest: bytes it may have.

    Raises:
        UsageError: it is missing, no plain file or too large, or as `parse_yaml`.
    """
    try:
        content = read_file(file, largest)
    except OSError as error:
        raise UsageError(f"cannot read {what} {file}: {error.strerror}; {near(file)}") from None
    return parse_yaml(content, str(file))


def parse_yaml(content: bytes | str, where: str) -> Any:
    """Return the values of one document; None for an empty one.

    Args:
        where: where the text stands, for the message.

    Raises:
        UsageError: it is not UTF-8 or not YAML, or is one of the things that this module refuses.
    """
    try:
        text = content if isinstance(content, str) else content.decode("utf-8")
        if not is_text(text):
            raise UsageError(f"{where} {NO_TEXT}")
        return _unfolded(_Loader(text).get_single_data())
    except UnicodeDecodeError:
        problem = "it is not UTF-8 text; save it as UTF-8"
    except RecursionError:
        problem = "it is nested too deeply"
    except yaml.YAMLError as error:
        problem = _in_words(error)
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
        # PyYAML lets these through: a date that is none, a number of too many digits, `!!int x`.
        problem = f"a value is not what it looks like: {error}"[:LONGEST]
    raise UsageError(f"{where} is not valid YAML: {problem}") from None


def parse_word(text: str, where: str) -> Any:
    """Return the value of a word on the command line. There `#` begins no comment and `&` no anchor: a text
    that YAML would shorten stays as it is.

    Raises:
        UsageError: as `parse_yaml`.
    """
    value, said = parse_yaml(text, where), text.strip()
    shortened = said not in EMPTY if value is None else isinstance(value, str) and value != said
    return said if shortened and said[0] not in "'\"!|>" else value


def check_dialect(text: str, where: str) -> None:
    """Refuse what this module refuses, in text that another parser reads and that need not be valid YAML.

    Raises:
        UsageError: a key is given twice, and so on.
    """
    try:
        _Loader(text).get_single_node()
    except _RefusedError as error:
        raise UsageError(f"{where} is not valid YAML: {_in_words(error)}") from None
    except (yaml.YAMLError, RecursionError, ValueError):
        return  # the other parser says what is wrong


class _RefusedError(ConstructorError):
    """A document that this module refuses and PyYAML would accept."""

    def __init__(self, node: yaml.Node, problem: str) -> None:
        super().__init__(None, None, problem, node.start_mark)


class _Loader(yaml.SafeLoader):
    """Checks each node of a document as it was written, before a value is made of it."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._sizes: dict[yaml.Node, int] = {}  # values in a part, with its aliases unfolded

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node:
        is_alias = self.check_event(yaml.AliasEvent)
        node = super().compose_node(parent, index)
        assert node is not None  # PyYAML's types say that it may be None
        if is_alias:
            if node not in self._sizes:
                raise _RefusedError(node, "it contains itself, through an alias")
            return node
        parts: list[yaml.Node] = []
        if isinstance(node, yaml.MappingNode):
            self._refuse_twins(node)
            parts = [part for pair in node.value for part in pair]
        elif isinstance(node, yaml.SequenceNode):
            parts = node.value
        elif "\0" in node.value:
            raise _RefusedError(node, "a text holds a zero character")
        elif not is_text(node.value):
            raise _RefusedError(node, f"{brief(node.value)} {NO_TEXT}")
        elif node.tag == _INT and _OCTAL.fullmatch(node.value):
            node.tag = _TEXT  # where a number is wanted, pydantic reads it as decimal
        self._sizes[node] = 1 + sum(self._sizes[part] for part in parts)
        if self._sizes[node] > MOST_VALUES:
            raise _RefusedError(node, f"it holds more than {MOST_VALUES} values, with its aliases unfolded")
        return node

    def _refuse_twins(self, node: yaml.MappingNode) -> None:
        lines: dict[Any, int] = {}
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge":
                name, line = self.construct_object(key), key.start_mark.line + 1
                if name in lines:
                    said = f"the key {brief(name)} is given twice, first in line {lines[name]}; keep one"
                    raise _RefusedError(key, said)
                lines[name] = line


def _unfolded(value: Any) -> Any:
    """A copy in which no two places share a part: to change one would change the other."""
    if isinstance(value, dict):
        return {key: _unfolded(part) for key, part in value.items()}
    return list(map(_unfolded, value)) if isinstance(value, list) else value


def _in_words(error: yaml.YAMLError) -> str:
    """PyYAML's message of several lines, in one."""
    if isinstance(error, yaml.MarkedYAMLError):
        problem = error.problem or error.context or "it cannot be read"
        begun = error.context_mark if error.context == "while scanning a simple key" else None
        mark = begun or error.problem_mark  # a missing ':' is noticed on a later line
        line = "" if mark is None else f"line {mark.line + 1}: "
        fix = next((fix for said, fix in _FIXES.items() if problem.startswith(said)), "")
        return line + problem[:LONGEST] + fix
    return " ".join(str(error).split())[:LONGEST]


_FIXES = {  # by the beginning of PyYAML's message
    "found character '\\t'": "; indent with spaces, not with tabs",
    "mapping values": "; give keys of one section the same indent, and put a text with ': ' in quotes",
    "expected <block end>": "; give keys of one section the same indent",
    "could not find expected ':'": "; write 'key: value'",
}
