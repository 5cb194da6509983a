"""Measures how fast and how good the node is; see README.md here. Not part of the installed package."""

from collections.abc import Callable

Advance = Callable[[int, int | None, str], None]  # done, of, what is measured now
