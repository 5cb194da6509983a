"""Whether a video file must have been longer, by the units in which its container writes.

FFmpeg does not say it: a transport stream holds neither length nor index, and the lengths that other
containers hold may be a second off.
"""

from __future__ import annotations

from pathlib import Path

PACKET = 188  # bytes of MPEG's transport streams, to which recorders add times or check sums: 192 or 204
SECTOR = 2048  # bytes of a DVD
_EBML, _SEGMENT = bytes.fromhex("1a45dfa3"), bytes.fromhex("18538067")  # of Matroska, RFC 8794 and 9559


def ends_in_a_packet(path: Path, size: int, container: str) -> bool:
    """Whether the last packet or sector is not whole, of files of `size` bytes that have such.

    Args:
        container: FFmpeg's name of it.
    """
    if path.suffix.lower() == ".vob":
        return size % SECTOR != 0
    if container != "mpegts":
        return False
    head = _head(path)
    for width in (PACKET, 192, 204):
        for at in range(width):
            if head[at::width][:4] == b"GGGG":  # each packet begins with a G; the time lies before it
                return (size - at) % width not in (0, PACKET)
    return False


def ends_in_its_segment(path: Path, size: int, container: str) -> bool:
    """Whether a Matroska file of `size` bytes says that it is longer; one that was never ended does not."""
    head = _head(path)
    if not container.startswith("matroska") or not head.startswith(_EBML):
        return False
    length, at = _length(head, len(_EBML))
    begins = at + (length or 0)
    if head[begins : begins + len(_SEGMENT)] != _SEGMENT:
        return False
    length, at = _length(head, begins + len(_SEGMENT))
    return length is not None and size < at + length


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(4096)


def _length(head: bytes, at: int) -> tuple[int | None, int]:
    """Length of an element's content, and where that begins; None: it is not known."""
    width = 9 - int.from_bytes(head[at : at + 1]).bit_length()  # its zeros in front say how long it is
    unknown = (1 << 7 * width) - 1
    length = int.from_bytes(head[at : at + width]) & unknown
    return (None if length == unknown else length), at + width
