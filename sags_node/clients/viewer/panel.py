"""The controls in the browser: status, pictures, plots, anchors, and what can be asked of the node."""

from __future__ import annotations

import html
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray
from viser import uplot

from sags_node.clients.viewer.feed import Moment, Status
from sags_node.clients.viewer.history import LENGTH, PERIOD, History
from sags_node.clients.viewer.pictures import Sheet
from sags_node.clients.viewer.scene import UNIT, Scene
from sags_node.errors import SagsError
from sags_node.messaging.address import NodeAddress
from sags_node.messaging.control import ControlClient

ANSWER_TIME = 20.0  # s; recordings take seconds
PICTURES_WIDTH = 480  # px
PLOT_HEIGHT = 80  # px
NOTICE_TIME = 6.0  # s
JPEG_QUALITY = 80
NONE = "-"  # no anchor chosen
BRIGHT, BLUE, ORANGE = "#c9d1d9", "#4dabf7", "#ffa94d"


class Asker:
    """Asks the node on behalf of a browser and tells it the answer."""

    def __init__(self, node: NodeAddress) -> None:
        self._node = node

    def ask(self, client: viser.ClientHandle | None, title: str, op: str, args: Mapping[str, Any]) -> None:
        """One request of its own: callbacks come from several threads."""
        try:
            with ControlClient.at(self._node) as control:
                answer = control.request(op, args, ANSWER_TIME)
        except SagsError as error:
            tell(client, f"{title}: refused", str(error), "red")
        else:
            tell(client, title, _in_words(answer), "green")


def tell(client: viser.ClientHandle | None, title: str, text: str, color: Any) -> None:
    """A notice in the browser that asked."""
    if client is not None:
        client.add_notification(title, text, color=color, auto_close_seconds=NOTICE_TIME)


class Panel:
    """Everything around the 3D scene.

    Args:
        rate: how often the browser is brought up to date at first, Hz.
    """

    def __init__(self, server: viser.ViserServer, scene: Scene, asker: Asker, ns: str, rate: float) -> None:
        self._gui, self._scene, self._asker = server.gui, scene, asker
        self._sheet, self._history = Sheet(), History()
        server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        server.gui.set_panel_label(f"sags view · {ns}")
        server.gui.main_panel.dock_right()
        self._status = server.gui.add_html(status_line(Moment("connecting")))
        self._build_view(rate)
        self._build_anchors()
        self._build_node()
        self._build_pictures()
        server.scene.on_click()(self._pin)

    @property
    def rate(self) -> float:
        """How often the browser should be brought up to date, Hz."""
        return float(self._rate.value)

    def show(self, moment: Moment) -> None:
        """Bring status, pictures, plots and the list of anchors up to date."""
        self._status.content = status_line(moment)
        self._pictures.image = self._sheet.draw(moment)
        if self._history.add(moment):
            for plot, figures in self._plots:
                plot.data = self._history.series(*figures)
        status = moment.status
        self._unit = "no unit" if status is not None and "uncalibrated" in status.warning_codes else "mm"
        self._list_anchors(moment.anchors)

    # ---- building ------------------------------------------------------------------------------------

    def _build_view(self, rate: float) -> None:
        buttons = self._gui.add_button_group("Look from", ("aside", "left camera"))

        @buttons.on_click
        def _(event: viser.GuiEvent[viser.GuiButtonGroupHandle]) -> None:
            if event.client is not None:
                self._scene.look(event.client, through=event.target.value == "left camera")

        self._rate = self._gui.add_slider("Updates per s", 1.0, 10.0, 1.0, rate)

    def _build_anchors(self) -> None:
        with self._gui.add_folder("Anchors"):
            self._pinning = self._gui.add_checkbox("Click on tissue pins one", True)
            self._anchor_rows = self._gui.add_html("")
            self._chosen = self._gui.add_dropdown("Anchor", (NONE,))
            remove = self._gui.add_button("Remove", icon=viser.Icon.TRASH)

        @remove.on_click
        def _(event: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
            if self._chosen.value == NONE:
                tell(event.client, "Remove", "choose an anchor first", "orange")
                return
            anchor = int(self._chosen.value)
            self._asker.ask(event.client, f"Remove anchor {anchor}", "remove_anchor", {"id": anchor})

    def _build_node(self) -> None:
        with self._gui.add_folder("Node"):
            self._offer("Pause", viser.Icon.PLAYER_PAUSE, "pause")
            self._offer("Resume", viser.Icon.PLAYER_PLAY, "resume")
            self._offer("Reset model", viser.Icon.REFRESH, "reset_model")
        with self._gui.add_folder("Recording", expand_by_default=False):
            folder = self._gui.add_text("Folder", "out/view")
            keep = self._gui.add_number("Keep last s (0: all)", 0.0, min=0.0)
            self._offer(
                "Start", viser.Icon.PLAYER_RECORD, "start_recording", lambda: _recording(folder, keep)
            )
            self._offer("Stop", viser.Icon.PLAYER_STOP, "stop_recording")
            self._offer("Snapshot of the last s", viser.Icon.CAMERA, "take_snapshot")

    def _offer(
        self,
        label: str,
        icon: viser.IconName,
        op: str,
        args: Callable[[], Mapping[str, Any]] = dict,
    ) -> None:
        """A button for one operation of the node."""

        @self._gui.add_button(label, icon=icon).on_click
        def _(event: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
            self._asker.ask(event.client, label, op, args())

    def _build_pictures(self) -> None:
        panel = self._gui.add_panel()
        with panel.add_tab("Pictures and figures"):
            self._pictures = self._gui.add_image(
                self._sheet.draw(Moment()), format="jpeg", jpeg_quality=JPEG_QUALITY
            )
            self._plots = [
                self._plot("Rate (Hz)", {"rate": BRIGHT}),
                self._plot("Latency (ms): p50 blue, p99 orange", {"p50": BLUE, "p99": ORANGE}),
                self._plot("PSNR on tissue (dB)", {"psnr": BRIGHT}),
            ]
        panel.dock_left()
        panel.set_width(PICTURES_WIDTH)

    def _plot(self, title: str, figures: Mapping[str, str]) -> tuple[viser.GuiUplotHandle, tuple[str, ...]]:
        """A plot of figures (name -> colour) over the last minutes."""
        grid = uplot.Axis_Grid(stroke="#333", width=1)
        across = uplot.Axis(stroke=BRIGHT, grid=grid, size=24)
        up = uplot.Axis(stroke=BRIGHT, grid=grid)
        lines = [uplot.Series(label=name, stroke=color, width=2) for name, color in figures.items()]
        plot = self._gui.add_uplot(
            self._history.series(*figures),
            (uplot.Series(label="s"), *lines),
            title=title,
            scales={"x": uplot.Scale(time=False, range=(-LENGTH * PERIOD, 0.0))},
            axes=(across, up),
            legend=uplot.Legend(show=False),
            height=PLOT_HEIGHT,
        )
        return plot, tuple(figures)

    # ---- anchors -------------------------------------------------------------------------------------

    def _pin(self, event: viser.SceneClickEvent) -> None:
        if not self._pinning.value:
            return
        splats = self._scene.splats
        if splats is None:
            tell(event.client, "Pin", "there is nothing to pin to now", "orange")
            return
        origin, direction = np.array(event.ray_origin) * UNIT, np.array(event.ray_direction)
        point = splats.hit(origin, direction)
        if point is None:
            tell(event.client, "Pin", "no tissue there", "orange")
            return
        place = {axis: float(x) for axis, x in zip("xyz", point, strict=True)}
        self._asker.ask(event.client, "Pin", "add_anchor", place)

    def _list_anchors(self, anchors: NDArray[Any] | None) -> None:
        rows = [] if anchors is None else list(anchors)
        self._anchor_rows.content = _anchor_table(rows, self._unit)
        if anchors is None:  # nothing fresh came: what somebody has chosen stays
            return
        numbers = (NONE, *(str(int(row["id"])) for row in rows))
        if self._chosen.options != numbers:
            self._chosen.options = numbers  # viser keeps the choice while it is there


def _recording(folder: viser.GuiTextHandle, keep: viser.GuiNumberHandle[float]) -> dict[str, Any]:
    """A new folder each time, on the node's machine."""
    args: dict[str, Any] = {"path": f"{folder.value}_{time.strftime('%Y%m%d_%H%M%S')}"}
    return args | ({"snapshot_seconds": float(keep.value)} if keep.value else {})


def _in_words(answer: Any) -> str:
    if not isinstance(answer, Mapping):
        return "done"
    return ", ".join(f"{key}: {value}" for key, value in answer.items()) or "done"


def status_line(moment: Moment) -> str:
    """One line: why nothing is shown, or how the node does; below it what it warns of."""
    status = moment.status
    if moment.problem is not None:
        color, text = "#ff922b", moment.problem
    else:
        latency = status.latency_ms.get("p50", np.nan)
        figures = f"{status.rate_hz:.1f} Hz, {latency:.0f} ms, {status.gaussians} Gaussians"
        if status.rung is not None:
            figures += f", rung {status.rung.number} of 0 to {status.rung.of - 1}"
        color, text = "#51cf66", f"{status.state}: {figures}"
    if status.last_error is not None:
        text += f" ({status.last_error})"
    style = f"padding:0.4em 1em;font-size:0.9em;color:{color}"
    return f'<div id="sags-status" style="{style}">{html.escape(text)}</div>{_warnings(status)}'


def _warnings(status: Status) -> str:
    """One line for each."""
    style = f"margin:0.2em 1em;padding-left:0.5em;font-size:0.9em;border-left:3px solid;color:{ORANGE}"
    return "".join(
        f'<div class="sags-warning" style="{style}">{html.escape(said)} '
        f'<span style="opacity:0.6">({html.escape(code)})</span></div>'
        for code, said in status.warning_codes.items()
    )


def _anchor_table(rows: list[Any], unit: str) -> str:
    """Where each anchor is, and how sure it is."""
    if not rows:
        return '<div style="padding:0 1em;opacity:0.7">none yet</div>'
    cells = []
    for row in rows:
        place = " ".join(f"{row[axis] / UNIT:.1f}" for axis in "xyz") if np.isfinite(row["x"]) else "lost"
        seen, sure = f"{100 * row['visibility']:.0f} %", f"{100 * row['confidence']:.0f} %"
        values = (int(row["id"]), place, seen, sure)
        cells.append("<tr>" + "".join(f"<td>{value}</td>" for value in values) + "</tr>")
    heads = "".join(f"<th align=left>{head}</th>" for head in ("", f"x y z ({unit})", "seen", "sure"))
    return f'<table style="padding:0 1em;width:100%"><tr>{heads}</tr>{"".join(cells)}</table>'
