"""The content of each topic, made from one frame (`FrameResult`) or the node's health (`NodeHealth`)."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from sags_node.confidence import confidence_of, error_of
from sags_node.findings import UNHEALTHY, by_code, in_words
from sags_node.geometry import project
from sags_node.messaging import cdr, published
from sags_node.messaging.cdr import Content, Status
from sags_node.types import (
    F32,
    SH_DEGREE_0,
    Bool,
    ClockStatus,
    DrawnView,
    FrameResult,
    Gaussians,
    NodeHealth,
    RectifiedPair,
    RenderedView,
    Side,
)

SLOPE_FIELDS = ("slope_0", "slope_1", "slope_2")
SPLAT_FIELDS = (
    *("x", "y", "z"),
    *("scale_0", "scale_1", "scale_2"),
    *("rot_w", "rot_x", "rot_y", "rot_z"),
    *("f_dc_0", "f_dc_1", "f_dc_2"),
    *("opacity", "id", "confidence", "id_high"),
    *SLOPE_FIELDS,
)
HEALTHY = ("running", "paused")  # states
POINT_FIELDS = ("x", "y", "z", "rgb", "confidence")
STRAIN_FIELDS = ("strain_max", "strain_min", "strain_s")
ANCHOR_FIELDS = (
    *("x", "y", "z", "id", "u", "v", "visibility", "age", "confidence", "depth_confidence"),
    *("ahead", "x_ahead", "y_ahead", "z_ahead", "u_ahead", "v_ahead"),
)
INSTRUMENT_FIELDS = (
    *("x", "y", "z", "id", "axis_x", "axis_y", "axis_z", "u", "v", "confidence"),
    *("distance", "distance_confidence", "clearance", "clearance_confidence", "source"),
    *("near_x", "near_y", "near_z"),
)
POINT_MIN_OPACITY = 0.1
POINT_BEHIND_SURFACE = 0.003  # m; a Gaussian deeper than this under the drawn surface is not visible


def splats(result: FrameResult) -> Content:
    """Every Gaussian as one row of `SPLAT_FIELDS`, activated and at the time of the frame."""
    gaussians = result.snapshot.gaussians
    rows = np.empty((len(gaussians), len(SPLAT_FIELDS)), np.float32)
    rows[:, 0:3] = gaussians.means
    rows[:, 3:6] = gaussians.scales
    rows[:, 6:10] = gaussians.quats / np.linalg.norm(gaussians.quats, axis=1, keepdims=True)
    rows[:, 10:13] = (gaussians.colors - 0.5) / SH_DEGREE_0
    rows[:, 13] = gaussians.opacities
    rows[:, 15] = _confidence(gaussians)
    rows[:, 17:20] = 0 if gaussians.slopes is None else gaussians.slopes
    bits = rows.view(np.uint32)
    bits[:, 14], bits[:, 16] = gaussians.ids & 0xFFFFFFFF, gaussians.ids >> 32  # low and high 32 bits
    return cdr.point_cloud(rows, SPLAT_FIELDS, result.pair.t_capture_ns)


def gaussians_of(points: NDArray[Any]) -> Gaussians:
    """Convert rows [N] of the topic `splats` to Gaussians. Older nodes send no confidence and no slopes."""
    names = points.dtype.names or ()

    def columns(*wanted: str) -> F32:
        return np.stack([points[name] for name in wanted], axis=-1)

    return Gaussians(
        means=columns("x", "y", "z"),
        quats=columns("rot_w", "rot_x", "rot_y", "rot_z"),
        scales=columns("scale_0", "scale_1", "scale_2"),
        opacities=np.ascontiguousarray(points["opacity"]),
        colors=0.5 + np.float32(SH_DEGREE_0) * columns("f_dc_0", "f_dc_1", "f_dc_2"),
        ids=points["id"].astype(np.int64),
        depth_errors=error_of(points["confidence"]) if "confidence" in names else None,
        slopes=columns(*SLOPE_FIELDS) if set(SLOPE_FIELDS) <= set(names) else None,
    )


def points(result: FrameResult) -> Content:
    """The Gaussians that the left eye sees, as rows of `POINT_FIELDS`, and `STRAIN_FIELDS` if wanted."""
    gaussians = result.snapshot.gaussians
    seen = _visible(result)
    rgb = np.clip(gaussians.colors[seen] * 255 + 0.5, 0, 255).astype(np.uint32)
    fields = POINT_FIELDS if result.strain is None else (*POINT_FIELDS, *STRAIN_FIELDS)
    rows = np.empty((len(rgb), len(fields)), np.float32)
    rows[:, 0:3] = gaussians.means[seen]
    rows.view(np.uint32)[:, 3] = rgb[:, 0] << 16 | rgb[:, 1] << 8 | rgb[:, 2]
    rows[:, 4] = _confidence(gaussians)[seen]
    if result.strain is not None:
        rows[:, 5:7] = result.strain.at(gaussians)[seen]
        rows[:, 7] = 1e-9 * (result.snapshot.t_capture_ns - result.strain.since_ns)
    return cdr.point_cloud(rows, fields, result.pair.t_capture_ns)


def anchors(result: FrameResult) -> Content:
    """The points pinned to the tissue, as rows of `ANCHOR_FIELDS`; the position of a lost one is NaN."""
    states = published.anchors(result.pair, result.anchors)
    rows = np.empty((len(states), len(ANCHOR_FIELDS)), np.float32)
    rows[:, 0:3] = states.points
    rows.view(np.uint32)[:, 3] = states.ids.astype(np.uint32)
    rows[:, 4:6] = states.pixels
    rows[:, 6], rows[:, 7], rows[:, 8] = states.visibility, states.ages, states.confidence
    rows[:, 9] = states.depth_confidence
    ahead = states.ahead
    rows[:, 10] = 0 if ahead is None else ahead.seconds
    rows[:, 11:14] = states.points if ahead is None else ahead.points
    rows[:, 14:16] = states.pixels if ahead is None else ahead.pixels
    dense = bool(np.isfinite(states.points).all())
    return cdr.point_cloud(rows, ANCHOR_FIELDS, result.pair.t_capture_ns, dense)


def instruments(result: FrameResult) -> Content:
    """The instruments, as rows of `INSTRUMENT_FIELDS`; what is not known is NaN."""
    states = result.instruments
    assert states is not None  # else it is not published
    rows = np.empty((len(states), len(INSTRUMENT_FIELDS)), np.float32)
    rows[:, 0:3], rows[:, 4:7], rows[:, 9] = states.tips, states.axes, states.confidence
    rows.view(np.uint32)[:, 3] = states.ids.astype(np.uint32)
    rows[:, 7:9] = published.pixels(result.pair, states.pixels)
    rows[:, 10], rows[:, 11] = states.distance, states.distance_confidence
    rows[:, 12], rows[:, 13] = states.clearance, states.clearance_confidence
    rows[:, 14], rows[:, 15:18] = states.sources, states.nearest
    dense = bool(np.isfinite(states.tips).all())
    return cdr.point_cloud(rows, INSTRUMENT_FIELDS, result.pair.t_capture_ns, dense)


def view_topics(name: str, stereo: bool, depth: bool) -> list[str]:
    """The topics of a view, without the namespace."""
    kinds = ("image", "camera_info", *(("depth", "depth_confidence") if depth else ()))
    return [
        f"view/{name}/{eye}{kind}" for eye in (("left/", "right/") if stereo else ("",)) for kind in kinds
    ]


def view(name: str, drawn: DrawnView) -> dict[str, Content]:
    """Return the content of a consumer's view, by topic name without the namespace."""
    said = {}
    for eye, shown in drawn.eyes.items():
        topic = f"view/{name}/{eye}/" if eye else f"view/{name}/"
        frame = f"{topic[:-1].replace('/', '_')}_optical_frame"
        stamp_ns, baseline = shown.t_capture_ns, drawn.baseline if eye == "right" else 0.0
        said[f"{topic}camera_info"] = cdr.camera_info(shown.camera, stamp_ns, frame, baseline)
        size = shown.camera.width, shown.camera.height
        said[f"{topic}image"] = _drawn(shown, size, stamp_ns, frame)
        if drawn.depth:
            said[f"{topic}depth"] = cdr.image(_depth(shown.depth), "32FC1", stamp_ns, frame)
            if shown.confidence is not None:
                confidence = cdr.image(shown.confidence, "32FC1", stamp_ns, frame)
                said[f"{topic}depth_confidence"] = confidence
    return said


def _visible(result: FrameResult) -> Bool:
    """Which Gaussians [N] lie in the left image and not under the surface drawn there."""
    view, gaussians = result.views["left"], result.snapshot.gaussians
    height, width = view.depth.shape
    pixels, depths = project(view.camera, gaussians.means)
    pixels = np.where(depths[:, None] > 0, pixels, -1.0)  # behind the camera: outside
    inside = np.all((pixels > -0.5) & (pixels < (width - 0.5, height - 0.5)), axis=1)
    columns, rows = np.rint(np.where(inside[:, None], pixels, 0.0)).astype(np.intp).T
    surface = view.depth[rows, columns]
    near = (surface == 0) | (depths < surface + POINT_BEHIND_SURFACE)
    visible: Bool = inside & near & (gaussians.opacities >= POINT_MIN_OPACITY)
    return visible


def _drawn(view: RenderedView, size: tuple[int, int], stamp_ns: int, frame: str) -> Content:
    """A rendered view with straight alpha, [H, W, 4]."""
    rgba = cv2.cvtColor(published.colours(view, size), cv2.COLOR_RGB2RGBA)
    alpha = cv2.convertScaleAbs(published.alpha(view, size), alpha=255.0)  # scales, rounds, saturates at once
    image = cdr.image(cv2.insertChannel(alpha, rgba, 3), "rgba8", stamp_ns, frame)
    return replace(image, detail_age_ns=published.detail_age_ns(view))


def _eye(result: FrameResult, side: Side) -> Content:
    """The model as an eye sees it."""
    size, stamp_ns = published.size_of(result.pair), result.pair.t_capture_ns
    return _drawn(result.views[side], size, stamp_ns, cdr.FRAMES[side])


def _confidence(gaussians: Gaussians) -> F32:
    """The confidence [N] 0..1 of each Gaussian's depth; NaN: unknown."""
    if gaussians.depth_errors is None:
        return np.full(len(gaussians), np.float32(np.nan))
    return confidence_of(gaussians.depth_errors)


def _depth_confidence(result: FrameResult) -> Content:
    confidence = result.views["left"].confidence
    assert confidence is not None  # else it is not published
    return cdr.image(published.nearest(result.pair, confidence), "32FC1", result.pair.t_capture_ns)


def _depth(depth: F32) -> F32:
    """REP 117: what is unknown is NaN on the wire."""
    return np.where(depth > 0, depth, np.float32(np.nan))


def _depth_image(pair: RectifiedPair, depth: F32) -> Content:
    return cdr.image(_depth(published.nearest(pair, depth)), "32FC1", pair.t_capture_ns)


def _mask(result: FrameResult) -> Content:
    tissue = published.nearest(result.pair, result.observation.tissue)
    return cdr.image(tissue.view(np.uint8) * np.uint8(255), "mono8", result.pair.t_capture_ns)


def picture(pair: RectifiedPair, side: Side) -> Content:
    """The rectified image of an eye."""
    return cdr.image(published.picture(pair, side), "rgb8", pair.t_capture_ns, cdr.FRAMES[side])


def _camera_info(pair: RectifiedPair, side: Side) -> Content:
    baseline = pair.baseline if side == "right" else 0.0
    return cdr.camera_info(published.camera_of(pair), pair.t_capture_ns, cdr.FRAMES[side], baseline)


FRAME_CONTENT: Mapping[str, Callable[[FrameResult], Content]] = {
    "left/image_rect_color": lambda r: picture(r.pair, "left"),
    "right/image_rect_color": lambda r: picture(r.pair, "right"),
    "left/camera_info": lambda r: _camera_info(r.pair, "left"),
    "right/camera_info": lambda r: _camera_info(r.pair, "right"),
    "left/render/image": lambda r: _eye(r, "left"),
    "right/render/image": lambda r: _eye(r, "right"),
    "left/render/depth": lambda r: _depth_image(r.pair, r.views["left"].depth),
    "left/render/depth_confidence": _depth_confidence,
    "left/depth": lambda r: _depth_image(r.pair, r.observation.depth),
    "left/tissue_mask": _mask,
    "points": points,
    "splats": splats,
    "anchors": anchors,
    "instruments": instruments,
    "tf": lambda r: cdr.transform(r.pair.camera.T_world_cam, r.pair.t_capture_ns),
}


OF_THE_MODEL = (
    *("left/render/image", "right/render/image", "left/render/depth", "left/render/depth_confidence"),
    *("points", "splats", "anchors", "instruments", "tf"),
)


def tells_of(result: FrameResult, topic: str) -> bool:
    """Tell whether a frame has content for a topic. A held frame has none of the model. The depth may not
    have been measured for lack of time. The right eye is drawn only while somebody looks at it, and so is the
    left eye's detail: who comes gets the next frame, which has it.
    """
    lacks = {
        "left/render/image": result.plain,
        "right/render/image": "right" not in result.views,
        "instruments": result.instruments is None,
        "left/render/depth_confidence": result.views["left"].confidence is None,
        "left/depth": result.hurried,
    }
    of_no_eye = topic.startswith("right/") and result.pair.right is None
    return not (of_no_eye or lacks.get(topic) or (result.held and topic in OF_THE_MODEL))


def health_fields(health: NodeHealth) -> dict[str, Any]:
    """The fields of `NodeHealth`, its warnings by stage and by code."""
    fields: dict[str, Any] = msgspec.to_builtins(health)
    return fields | {"warnings": in_words(health.warnings), "warning_codes": by_code(health.warnings)}


def status(health: NodeHealth, last: FrameResult | None) -> dict[str, Any]:
    """Return `health_fields`, and under `last_frame` its loss, counts and what was skipped."""
    fields = health_fields(health)
    fields["last_frame"] = (
        {}
        if last is None
        else {
            "frame_id": last.pair.frame_id,
            "loss": last.snapshot.loss,
            "skipped": dict(last.skipped),
            "counts": dict(last.snapshot.counts),
        }
    )
    return fields


def health_answer(health: NodeHealth) -> dict[str, Any]:
    """Return the node's state, its warnings, and whether it is healthy: running or paused, and without a
    warning of `UNHEALTHY`."""
    codes = list(by_code(health.warnings))
    healthy = health.state in HEALTHY and UNHEALTHY.isdisjoint(codes)
    return {"healthy": healthy, "state": health.state, "warnings": codes}


def json_text(value: Mapping[str, Any]) -> Content:
    """A JSON object as `std_msgs/String`; a number that is not finite becomes null."""
    return cdr.string(msgspec.json.encode(value).decode())


def _clock_values(clock: ClockStatus | None) -> dict[str, str]:
    if clock is None:
        return {}
    values = {"capture_clock_offset_ms": f"{clock.offset_ms:.1f}"}
    return (
        values if clock.drift_ppm is None else values | {"capture_clock_drift_ppm": f"{clock.drift_ppm:.1f}"}
    )


def diagnostics(health: NodeHealth, stamp_ns: int) -> Content:
    """One status for the node, one per stage."""
    level = {"running": 0, "stopping": 0}.get(health.state, 1)
    values = {
        "rate_hz": f"{health.rate_hz:.2f}",
        "gaussians": str(health.gaussians),
        "rss_mb": f"{health.rss_mb:.0f}",
        **{f"latency_{name}_ms": f"{ms:.1f}" for name, ms in health.latency_ms.items()},
        **_clock_values(health.clock),
        **{f"dropped_{slot}": str(count) for slot, count in health.dropped.items()},
        **{
            f"{socket}_connections_{what}": str(count)
            for socket, counts in health.connections.items()
            for what, count in counts.items()
        },
    }
    statuses = [Status("node", level, health.last_error or health.state, values)]
    running = health.state in ("running", "held", "degraded")
    for stage, ms in health.stage_ms.items():
        statuses.append(Status(stage, 0 if running else 3, f"{ms:.1f} ms", {"ms": f"{ms:.3f}"}))
    statuses += [
        Status(stage, 1, warning, by_code({stage: health.warnings[stage]}))
        for stage, warning in in_words(health.warnings).items()
    ]
    return cdr.diagnostics(statuses, stamp_ns)
