"""A layout for Foxglove: images, cloud with anchors, figures and what is wrong, at once."""

import json
from collections.abc import Iterable
from typing import Any

from foxglove import layouts as fl
from foxglove.layouts import Layout, SplitContainer, SplitItem

from sags_node.clients.bridge.foxglove import CLICKED, FIGURES
from sags_node.messaging import cdr

COLORS = ("#4e98e2", "#f5774d", "#f7df71", "#a395e2")


def layout_of(ns: str, overlay_ns: str) -> str:
    """The layout's file, for these namespaces."""
    topic = f"/{ns}{FIGURES}"
    shown = (f"/{ns}/left/image_rect_color", f"/{ns}/left/render/image", f"/{overlay_ns}/left/overlay/image")
    latencies = {f"latency_ms.{part}": f"latency {part}, ms" for part in ("p50", "p90", "p99")}
    figures = (
        _plot(topic, "Hz", {"rate_hz": "rate, Hz"}),
        _plot(topic, "ms", latencies),
        _plot(topic, "", {"gaussians": "Gaussians"}),
        fl.RawMessagesPanel(config=fl.RawMessagesConfig(topic_path=f"{topic}.warnings")),
    )
    content = SplitContainer(
        direction="row",
        items=[
            SplitItem(proportion=3, content=_column(_picture(name, ns) for name in shown)),
            SplitItem(proportion=4, content=_scene(ns)),
            SplitItem(proportion=3, content=_column(figures)),
        ],
    )
    return json.dumps(json.loads(Layout(content=content).to_json()), indent=1) + "\n"


def _column(panels: Iterable[Any]) -> SplitContainer:
    return SplitContainer(direction="column", items=[SplitItem(content=panel) for panel in panels])


def _picture(topic: str, ns: str) -> fl.ImagePanel:
    mode = fl.ImageModeConfig(
        image_topic=topic, calibration_topic=f"/{ns}/left/camera_info", synchronize=False
    )
    return fl.ImagePanel(config=fl.ImageConfig(image_mode=mode))


def _scene(ns: str) -> fl.ThreeDeePanel:
    """The points in their colours, the anchors larger and coloured by confidence; from the camera's side."""
    points = fl.BaseRendererPointCloudTopicSettings(
        visible=True, color_mode="rgb", color_field="rgb", point_size=3
    )
    anchors = fl.BaseRendererPointCloudTopicSettings(
        visible=True, color_mode="colormap", color_map="turbo", color_field="confidence",
        min_value=0, max_value=1, point_size=14,
    )  # fmt: skip
    view = fl.ThreeDeeCameraState(
        distance=0.2, phi=150, theta_offset=0, target=(0, 0, 0.09), perspective=True, near=0.001, far=10
    )
    config = fl.ThreeDeeConfig(
        camera_state=view,
        follow_tf=cdr.WORLD_FRAME,
        follow_mode="follow-none",
        topics={f"/{ns}/points": points, f"/{ns}/anchors": anchors},
        publish=fl.ThreeDeePublishSettings(type="point", point_topic=CLICKED),
    )
    return fl.ThreeDeePanel(config=config)


def _plot(topic: str, unit: str, values: dict[str, str]) -> fl.PlotPanel:
    series = [
        fl.PlotSeries(value=f"{topic}.{path}", label=label, color=color)
        for (path, label), color in zip(values.items(), COLORS, strict=False)
    ]
    return fl.PlotPanel(
        config=fl.PlotConfig(paths=series, y_axis_label=unit, following_view_width=30, show_legend=True)
    )
