"""Stereo frames as a source gives them."""

from __future__ import annotations

from sags_node.types import U8, Bool, StereoFrame


def make_frame(left: U8, right: U8, tissue: Bool | None = None) -> StereoFrame:
    return StereoFrame(7, 1_000, 2_000, left, right, tissue=tissue)
