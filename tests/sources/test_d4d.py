"""The real recording d4d_pull: colours, depth, instrument masks, and exact seeking."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from sags_node.config import schema as cfg
from sags_node.sources.source import open_source


@pytest.fixture(scope="module")
def folder(data_folder: Path) -> Path:
    folder = data_folder / "d4d_pull"
    if not folder.is_dir():
        pytest.skip(f"recording d4d_pull is not under SAGS_DATA ({data_folder})")
    return folder


def d4d(folder: Path, **playing: object) -> cfg.VideosSource:
    return cfg.VideosSource(
        left=folder / "2025_03_06-16_49_40_combined_2x2.mp4",
        geometry=cfg.GeometryConfig(layout="panes", crop=(0, 0, 675, 540), crop_right=(675, 0, 675, 540)),
        tools=(675, 540, 675, 540),
        pace="step",
        reference=cfg.ReferenceConfig(depth=folder / "depth_mm_x100", depth_kind="stereo_network"),
    ).model_copy(update=playing)


def test_d4d_clip(folder: Path) -> None:
    overlaps = []
    with open_source(d4d(folder)) as source:
        assert source.rate == 30 and source.frame_count == 179
        for index, frame in enumerate(source):
            assert frame.frame_id == index
            assert frame.left.shape == frame.right.shape == (540, 675, 3)
            assert frame.left[..., 0].mean() > frame.left[..., 1].mean()  # tissue is red: RGB, not BGR
            assert frame.tissue is not None
            assert (frame.reference is not None) == (index % 10 == 0)
            if frame.reference is None:
                continue
            assert frame.reference.depth is not None and frame.reference.depth_kind == "stereo_network"
            known = frame.reference.depth[frame.reference.depth > 0]
            assert 0.03 < float(np.median(known)) < 0.15  # metres
            mask = cv2.imread(str(folder / f"toolmask/{index:04d}.png"), cv2.IMREAD_GRAYSCALE)
            assert mask is not None
            tools, found = mask > 127, ~frame.tissue
            overlaps.append((tools & found).sum() / (tools | found).sum())
    assert index == 178
    assert len(overlaps) == 18
    assert np.median(overlaps) >= 0.95 and min(overlaps) >= 0.9


def test_d4d_seeks_to_the_exact_frame(folder: Path) -> None:
    with open_source(d4d(folder, frames=92), references=False) as source:
        last = list(source)[-1]
    with open_source(d4d(folder, start=91 / 30, frames=1), references=False) as source:
        sought = next(iter(source))
    assert last.frame_id == sought.frame_id == 91
    assert (last.left == sought.left).all()
