"""Faces of a PLY file, looked at before Open3D reads them: it cuts polygons into triangles without a look at
their corners, and ends the process where one is missing."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from pathlib import Path

from sags_node.errors import UsageError
from sags_node.files import open_file

_TYPES = {
    "char": "b", "int8": "b", "uchar": "B", "uint8": "B", "short": "h", "int16": "h", "ushort": "H",
    "uint16": "H", "int": "i", "int32": "i", "uint": "I", "uint32": "I", "float": "f", "float32": "f",
    "double": "d", "float64": "d",
}  # fmt: skip
_PROPERTY = re.compile(r"property\s+(?:list\s+(\w+)\s+)?(\w+)\s+(\S+)")
_CORNERS = ("vertex_indices", "vertex_index")

Next = Callable[[str], float]  # the next number of a type


def check_faces(file: Path) -> None:
    """Refuse faces with corners that there are not. What cannot be followed at all is left to the reader.

    Raises:
        UsageError: a face names a corner beyond the last one.
    """
    with open_file(file) as opened:
        header, _, body = opened.read().partition(b"end_header")
    try:
        wrong = _beyond(header.decode("ascii"), body)
    except (UnicodeError, KeyError, ValueError, OverflowError, IndexError, struct.error):
        return
    if wrong:
        raise UsageError(f"{file} is damaged: {wrong}; open it in a mesh viewer")


def _beyond(header: str, body: bytes) -> str:
    next_of = _reader(header, body)
    vertices = 0
    for part in re.split(r"^element\s+", header, flags=re.MULTILINE)[1:]:
        head, *lines = part.splitlines()
        name, count = head.split()
        properties = [found.groups() for found in map(_PROPERTY.match, lines) if found is not None]
        vertices = int(count) if name == "vertex" else vertices
        for _ in range(int(count)):
            for length_type, kind, called in properties:
                length = 1 if length_type is None else int(next_of(_TYPES[length_type]))
                if length < 0:
                    return f"a list of {length} numbers"
                values = [next_of(_TYPES[kind]) for _ in range(length)]
                if called in _CORNERS and (length < 3 or len(set(values)) < length != 3):
                    return f"a face has {len(set(values))} different corners of {length}"
                if called in _CORNERS and not all(0 <= value < vertices for value in values):
                    return "a face names a vertex that is not there"
    return ""


def _reader(header: str, body: bytes) -> Next:
    """What gives one number after the other."""
    if re.search(r"^format\s+ascii", header, re.MULTILINE):
        words = iter(body.split())

        def word(_: str) -> float:
            found = next(words, None)
            if found is None:
                raise ValueError("it ends too early")
            return float(found)

        return word
    order = "<" if "binary_little_endian" in header else ">"
    at = body.index(b"\n") + 1

    def number(kind: str) -> float:
        nonlocal at
        (value,) = struct.unpack_from(order + kind, body, at)
        at += struct.calcsize(kind)
        return float(value)

    return number
