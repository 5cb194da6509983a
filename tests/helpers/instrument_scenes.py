"""Drawn masks of instruments, and one that the phantom films."""

from functools import cache
from typing import NamedTuple

import cv2
import numpy as np

from sags_node.geometry import unproject
from sags_node.phantom.instruments import NOTHING, Instruments, joined
from sags_node.phantom.scene import Phantom, PhantomScene
from sags_node.types import F64, Bool, Camera, Colours, RectifiedPair, RenderedView, StereoFrame
from sags_node.vision.rectify import Rectifier

WIDTH, HEIGHT = 320, 256


def bars(*ends: tuple[tuple[int, int], tuple[int, int]], thick: int = 24) -> Bool:
    """A mask [HEIGHT, WIDTH] of straight instruments, each from one place to its tip (u v), flat there."""
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    for start, tip in ends:
        way = np.subtract(tip, start) / np.linalg.norm(np.subtract(tip, start))
        aside = 0.5 * thick * np.array([-way[1], way[0]])
        corners = np.array([start + aside, tip + aside, tip - aside, start - aside])
        cv2.fillPoly(mask, [np.rint(corners).astype(np.int32)], 1)
    return mask.view(np.bool_)


class Filmed(NamedTuple):
    """A grasper before the phantom."""

    pair: RectifiedPair
    tools: Bool
    surface: RenderedView  # the exact one
    tip: F64  # [3] m
    axis: F64  # [3]
    frame: StereoFrame
    phantom: Phantom


@cache
def filmed() -> Filmed:
    phantom = Phantom(PhantomScene(seconds=1, width=WIDTH, height=HEIGHT, still_tissue=True))
    camera = Camera(WIDTH, HEIGHT, phantom.rig.left.P[:, :3].astype(np.float64), np.eye(4))
    trocar = np.array([-0.105, 0.125, -0.01])
    tip = np.asarray(unproject(camera, np.array([170.0, 120.0]), np.array(0.055)))
    mesh = Instruments().grasper(tip, trocar)
    axis = (tip - trocar) / np.linalg.norm(tip - trocar)
    bare, seen = phantom.frame(0, 1, tools=NOTHING), phantom.frame(0, 1, tools=joined([mesh]))
    frame = StereoFrame(0, 10**9, 10**9, seen.left, seen.right, tissue=~seen.tool)
    rectifier = Rectifier(phantom.rig, WIDTH, HEIGHT)
    depth, sure = bare.depth, np.full(bare.depth.shape, 0.9, np.float32)
    surface = RenderedView(0, 10**9, camera, Colours(seen.left), depth, sure, sure)
    end = tip + axis * float(((mesh.vertices - tip) @ axis).max())
    return Filmed(rectifier(frame), ~rectifier.mask(~seen.tool), surface, end, axis, frame, phantom)
