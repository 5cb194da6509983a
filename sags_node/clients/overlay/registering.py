"""`sags register`: a model placed on the tissue of a running node, and the scene file that says so."""

import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sags_node.clients.overlay.frame import CONFIDENCE, NEEDED, TissueFrame, tissue_frame
from sags_node.clients.overlay.mesh import surface_of
from sags_node.clients.overlay.scene import LONGEST_LABEL, PairSpec, PairsSpec
from sags_node.clients.registration.register import register
from sags_node.clients.registration.surfaces import Shape, Surface
from sags_node.confidence import SURE
from sags_node.errors import SagsError, UsageError
from sags_node.geometry import invert, transform, unproject
from sags_node.messaging.address import NodeAddress
from sags_node.messaging.subscriber import Subscriber
from sags_node.types import F64

FRAMES = 10  # spread over the time that is looked at
PATIENCE = 10.0  # s to wait for frames beyond the time that is looked at
WAIT_FOR_REST = 0.2  # s for what belongs to a frame
LEAST_SHARE = 0.5  # of the frames, in which a picked point must be known
HOLDING = 8  # anchors that the scene file gets
INNER = 0.8  # share of the matched points, nearest to their middle: anchors at a rim are lost first


def register_live(
    model: Path, scale: float, pairs: PairsSpec, node: NodeAddress, seconds: float, scene: Path
) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """Place a model on the tissue that a node sees.

    Args:
        scale: metres per unit of the model's file.
        seconds: how long the surface is looked at.
        scene: where the scene file will lie.

    Returns:
        What was found, see `Registration.figures`; and the content of the scene file, None if it was refused.

    Raises:
        UsageError: the file cannot be used, or a pixel lies outside the image.
        SagsError: no node, no frames, no calibration, or a picked point has no depth.
    """
    mesh = surface_of(model, scale)
    vertices = mesh.vertices.astype(np.float64)
    targets = scale * np.array(pairs.targets, np.float64).reshape(-1, 3)
    if not len(targets):
        targets = 0.5 * (vertices.min(0) + vertices.max(0))[None]
    seen = frames_of(node, seconds)
    places = np.array([_place(pair, number, seen) for number, pair in enumerate(pairs.pairs, 1)])
    surface = Surface.joined([frame.surface(frame.tissue) for frame in seen])
    at = scale * np.array([pair.at for pair in pairs.pairs], np.float64)
    found = register(Shape(vertices, mesh.triangles), at, places.reshape(-1, 3), surface, targets)
    said = found.figures(targets / scale)
    if found.verdict == "refused":
        return said, None
    assert found.T_world_model is not None and found.matched is not None
    said |= {"session": seen[-1].session, "epoch": seen[-1].epoch}  # in whose world its places are
    held = holding(surface.points[found.matched])
    local = transform(invert(found.T_world_model), held) / scale
    anchors = [
        {"place": _short(place), "at": _short(point)} for place, point in zip(held, local, strict=True)
    ]
    # `..` of a linked folder is where the link leads to.
    file = os.path.relpath(model.parent.resolve() / model.name, scene.parent.resolve())
    thing = {"file": file, "scale": scale, "at_units": "file", "label": model.stem[:LONGEST_LABEL]}
    return said, {"objects": [thing | {"anchors": anchors, "registration": said}]}


def frames_of(node: NodeAddress, seconds: float) -> list[TissueFrame]:
    """Return up to `FRAMES` frames, spread over `seconds` of one session and epoch, without a longer gap.

    Raises:
        SagsError: no frames, or no calibration.
    """
    seen: list[TissueFrame] = []
    apart_ns, deadline, last = 1e9 * seconds / FRAMES, time.monotonic() + PATIENCE + seconds, None
    with Subscriber.at(node, [*NEEDED, CONFIDENCE]) as subscriber:
        while not seen or seen[-1].stamp_ns - seen[0].stamp_ns < (FRAMES - 1) * apart_ns:
            last = subscriber.wait(NEEDED[0], max(0.0, deadline - time.monotonic()), after=last)
            if last is None:
                break
            whole = subscriber.aligned([*NEEDED, CONFIDENCE], last.stamp_ns, WAIT_FOR_REST)
            frame = None if whole is None else tissue_frame(whole, None, whole[CONFIDENCE], ahead=False)
            if frame is None or subscriber.problem(NEEDED[0]) is not None:
                continue
            if not last.metric:
                raise SagsError("the node has no calibration, so nothing has a length: see sags calib")
            if seen and (frame.session, frame.epoch) != (seen[0].session, seen[0].epoch):
                seen.clear()  # places of before are of another world
            if seen and frame.stamp_ns - seen[-1].stamp_ns > 1e9 * seconds:
                seen.clear()  # the tissue may have moved since: frames were held, or the node was paused
            if not seen or frame.stamp_ns - seen[-1].stamp_ns >= apart_ns:
                seen.append(frame)
        if not seen:
            why = subscriber.refusal or subscriber.problem(NEEDED[0]) or "no frame was whole"
            raise SagsError(f"no depth came from {subscriber.endpoint}: {why}; does the node run and map?")
    return seen


def _place(pair: PairSpec, number: int, seen: Sequence[TissueFrame]) -> F64:
    """The place of a pair's tissue, [3] m, world: the median over the frames."""
    found = [place for frame in seen if (place := _place_in(pair, number, frame)) is not None]
    if len(found) < LEAST_SHARE * len(seen):
        what = f"pixel {pair.pixel[0]:g} {pair.pixel[1]:g}" if pair.pixel else f"anchor {pair.anchor}"
        raise SagsError(
            f"pair {number}: {what} shows no tissue, or no depth that is known to 3 mm; choose another"
        )
    return np.asarray(np.median(found, axis=0), np.float64)


def _place_in(pair: PairSpec, number: int, frame: TissueFrame) -> F64 | None:
    assert frame.confidence is not None
    if pair.pixel is None:
        anchor = frame.anchors.get(pair.anchor or 0)
        if anchor is None:
            known = ", ".join(map(str, frame.anchors)) or "none"
            raise SagsError(f"pair {number}: there is no anchor {pair.anchor}; the node has {known}")
        return anchor.place if anchor.is_sure and anchor.depth_confidence >= SURE else None
    u, v = pair.pixel
    height, width = frame.depth.shape
    if not (-0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5):
        raise UsageError(f"pair {number}: pixel {u:g} {v:g} lies outside the image of {width}x{height} px")
    at = round(v), round(u)
    if not (frame.tissue[at] and frame.depth[at] > 0 and frame.confidence[at] >= SURE):
        return None
    return np.asarray(unproject(frame.camera, np.array([u, v]), np.array(frame.depth[at], np.float64)))


def holding(points: F64) -> F64:
    """Choose [k, 3] of the matched points [N, 3] that are far apart from each other."""
    import open3d as o3d

    away = np.linalg.norm(points - points.mean(0), axis=1)
    inner = o3d.utility.Vector3dVector(points[away <= np.quantile(away, INNER)])
    return np.asarray(o3d.geometry.PointCloud(inner).farthest_point_down_sample(HOLDING).points)


def _short(point: F64) -> list[float]:
    return [float(f"{value:.6g}") for value in point]
