"""The controls in the browser: status, images, plots, anchors, and what can be asked of the node."""

import html
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray
from viser import uplot

from sags_node.clients.viewer.cursor import depth_line
from sags_node.clients.viewer.feed import Moment, Status
from sags_node.clients.viewer.history import LENGTH, PERIOD, History
from sags_node.clients.viewer.overlay import Overlay
from sags_node.clients.viewer.pictures import VIEWS, Sheet
from sags_node.clients.viewer.saving import KINDS, Exporter, exported, screenshot
from sags_node.clients.viewer.scene import UNIT, Scene
from sags_node.confidence import SURE, is_sure_in_space
from sags_node.errors import SagsError
from sags_node.messaging.address import NodeAddress
from sags_node.messaging.control import ControlClient
from sags_node.types import F64

ANSWER_TIME = 20.0  # s; recordings take seconds
WIDTH = 400  # px, of images and controls
PLOT_HEIGHT = 80  # px
NOTICE_TIME = 6.0  # s
JPEG_QUALITY = 80
NONE = "-"  # no anchor chosen
OLD = "what you see is old: Go on first"
BRIGHT, BLUE, ORANGE = "#c9d1d9", "#4dabf7", "#ffa94d"


def tell(client: viser.ClientHandle | None, title: str, text: str, color: Any) -> None:
    """Show a notice in the browser that asked."""
    if client is not None:
        client.add_notification(title, text, color=color, auto_close_seconds=NOTICE_TIME)


class Panel:
    """Everything around the 3D scene.

    Args:
        rate: how often the browser is brought up to date at first, Hz.
    """

    def __init__(
        self, server: viser.ViserServer, scene: Scene, node: NodeAddress, exporter: Exporter, rate: float
    ) -> None:
        self._gui, self._scene, self._node, self._exporter = server.gui, scene, node, exporter
        self._sheet, self._history = Sheet(), History()
        self._moment, self._unit, self._session = Moment("connecting"), "mm", ""
        self._frozen_since: float | None = None
        self._awaited: set[str] = set()  # anchors pinned a moment ago: they come with one of the next frames
        server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        server.gui.set_panel_label(f"sags view · {node.ns}")
        server.gui.main_panel.dock_right()
        self._status = server.gui.add_html(status_line(self._moment))
        self._build_keeping()
        self._build_view(rate)
        self._build_anchors()
        with server.gui.add_folder("Overlay"):
            self._overlay = server.gui.add_html("")
        self._build_node()
        self._build_pictures()
        server.scene.on_click()(self._clicked)

    @property
    def rate(self) -> float:
        """The rate at which the browser should be brought up to date, Hz."""
        return float(self._rate.value)

    @property
    def view(self) -> str:
        """The one of the `VIEWS` that is looked at."""
        return str(self._view.value)

    @property
    def frozen(self) -> bool:
        """Tell whether the page is frozen at one moment."""
        return self._frozen_since is not None

    @property
    def chosen(self) -> int | None:
        """The anchor that the button Remove removes; None: none is chosen."""
        return None if self._chosen.value == NONE else int(self._chosen.value)

    def fit(self, client: viser.ClientHandle) -> None:
        """Leave half of a narrow browser to the scene."""
        client.gui.main_panel.set_width(min(WIDTH, client.camera.image_width // 2))

    def show(self, moment: Moment) -> None:
        """Bring status, images, plots and the list of anchors up to date."""
        self._moment = moment
        self._unit = "no unit" if "uncalibrated" in moment.status.warning_codes else "mm"
        self._say(moment)
        self._draw()
        if self._history.add(moment):
            for plot, figures in self._plots:
                plot.data = self._history.series(*figures)
        self._overlay.content = _overlay_table(moment.overlay)
        if moment.status.session not in ("", self._session):  # another node: that number is another anchor's
            self._session, self._awaited = moment.status.session, set()
            self._chosen.value = self._other.value = NONE  # type: ignore[misc]  # viser's setter, which mypy misses
        self._list_anchors(moment.anchors)

    def stay(self) -> None:
        """Show how old the frozen moment is by now. The view of it may still be changed."""
        assert self._frozen_since is not None
        age = time.monotonic() - self._frozen_since
        self._say(Moment(f"FROZEN {age:.0f} s ago: what you see is old; Go on shows the node again"))
        self._draw(f"  FROZEN {age:.0f} s ago")
        self._list_anchors(self._moment.anchors)

    def go_on(self) -> None:
        """Show the node again."""
        self._frozen_since, self._freeze.label = None, "Freeze"

    def _say(self, moment: Moment) -> None:
        self._status.content = status_line(moment, int(time.monotonic()))

    def _draw(self, remark: str = "") -> None:
        near, far = sorted((self._near.value * UNIT, self._far.value * UNIT))
        self._sheet.fixed = None if self._auto.value else (near, far)
        sheet = self._sheet.draw(self._moment, self.view, remark)
        self._pictures.image = sheet
        self._depth.content = depth_line(self._moment, self.view, sheet.shape[0], self._unit)

    # ---- building ------------------------------------------------------------------------------------

    def _button(
        self, label: str, icon: viser.IconName, do: Callable[[viser.ClientHandle], None]
    ) -> viser.GuiButtonHandle:
        button = self._gui.add_button(label, icon=icon)

        @button.on_click
        def _(event: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
            if event.client is not None:
                do(event.client)

        return button

    def _build_keeping(self) -> None:
        self._freeze = self._button("Freeze", viser.Icon.SNOWFLAKE, lambda _: self._freeze_or_go_on())
        self._button("Screenshot", viser.Icon.CAMERA, self._screenshot)
        with self._gui.add_folder("Export", expand_by_default=False):
            self._kind = self._gui.add_dropdown("What", KINDS)
            self._button("Download", viser.Icon.DOWNLOAD, self._export)

    def _build_view(self, rate: float) -> None:
        buttons = self._gui.add_button_group("Look from", ("aside", "left camera"))

        @buttons.on_click
        def _(event: viser.GuiEvent[viser.GuiButtonGroupHandle]) -> None:
            if event.client is not None:
                self._scene.look(event.client, through=event.target.value == "left camera")

        self._rate = self._gui.add_slider("Updates per s", 1.0, 30.0, 1.0, rate)

    def _build_anchors(self) -> None:
        with self._gui.add_folder("Anchors"):
            self._pinning = self._gui.add_checkbox("Click on tissue pins one", True)
            self._anchor_rows = self._gui.add_html("")
            self._chosen = self._gui.add_dropdown("Anchor", (NONE,), hint="or click on it in the scene")
            self._other = self._gui.add_dropdown("Distance to", (NONE,), hint="the one clicked before")
            self._distance = self._gui.add_html("")
            self._button("Remove", viser.Icon.TRASH, self._remove)

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
        self, label: str, icon: viser.IconName, op: str, args: Callable[[], Mapping[str, Any]] = dict
    ) -> None:
        """A button for one operation of the node."""
        self._button(label, icon, lambda client: self._ask(client, label, op, args()))

    def _build_pictures(self) -> None:
        panel = self._gui.add_panel()
        with panel.add_tab("Images and figures"):
            views = tuple(VIEWS)
            self._view = self._gui.add_dropdown("Show", views, initial_value=views[0])
            self._depth = self._gui.add_html("")
            self._pictures = self._gui.add_image(
                self._sheet.draw(self._moment, views[0]), format="jpeg", jpeg_quality=JPEG_QUALITY
            )
            with self._gui.add_folder("Depth colours", expand_by_default=False):
                self._auto = self._gui.add_checkbox("Follow the tissue", True)
                self._near = self._gui.add_number("Near (mm)", 50.0, min=1.0, max=1000.0, step=0.1)
                self._far = self._gui.add_number("Far (mm)", 150.0, min=1.0, max=1000.0, step=0.1)
            self._plots = [
                self._plot("Rate (Hz)", {"rate": BRIGHT}),
                self._plot("Latency (ms): p50 blue, p99 orange", {"p50": BLUE, "p99": ORANGE}),
                self._plot("Rung of the ladder of quality", {"rung": BRIGHT}),
            ]

        @self._auto.on_update
        def _(event: viser.GuiEvent[viser.GuiCheckboxHandle]) -> None:
            """Begin the fixed range of colours with the one that is shown."""
            if not event.target.value:
                near, far = self._sheet.shown
                self._near.value = round(near / UNIT, 1)  # type: ignore[misc]  # viser's setter, which mypy misses
                self._far.value = round(far / UNIT, 1)  # type: ignore[misc]  # as above

        panel.dock_above(self._gui.main_panel)

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

    # ---- what is asked for ---------------------------------------------------------------------------

    def _ask(self, client: viser.ClientHandle | None, title: str, op: str, args: Mapping[str, Any]) -> Any:
        """Ask by a connection of its own, as callbacks run on several threads. None: it was refused."""
        try:
            with ControlClient.at(self._node) as control:
                answer = control.request(op, args, ANSWER_TIME)
        except SagsError as error:
            tell(client, f"{title}: refused", str(error), "red")
            return None
        tell(client, title, _in_words(answer), "green")
        return answer

    def _freeze_or_go_on(self) -> None:
        if self.frozen:
            self.go_on()
        else:
            self._frozen_since, self._freeze.label = time.monotonic(), "Go on"

    def _screenshot(self, client: viser.ClientHandle) -> None:
        self._send(client, "Screenshot", ".png", lambda: screenshot(client, self._pictures.image))

    def _export(self, client: viser.ClientHandle) -> None:
        kind, moment = self._kind.value, self._moment
        self._send(client, f"Export {kind}", f"_{kind}.ply", lambda: exported(moment, kind, self._exporter))

    def _send(self, client: viser.ClientHandle, title: str, ending: str, make: Callable[[], bytes]) -> None:
        """Send a file of this moment, named by its time; by the time now where nothing is shown."""
        stamp = 1e-9 * self._moment.t_capture_ns or time.time()
        name = time.strftime("sags_%Y%m%d_%H%M%S", time.localtime(stamp)) + ending
        try:
            client.send_file_download(name, make(), save_immediately=True)
        except SagsError as error:
            tell(client, f"{title}: refused", str(error), "red")
        else:
            tell(client, title, name, "green")

    def _remove(self, client: viser.ClientHandle) -> None:
        anchor = self.chosen
        if anchor is None or self.frozen:
            why = "choose an anchor first" if anchor is None else OLD
            tell(client, "Remove", why, "orange")
            return
        self._ask(client, f"Remove anchor {anchor}", "remove_anchor", {"id": anchor})

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        """A click on an anchor chooses it; one on the tissue pins a new one."""
        origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)
        hit = self._scene.anchor_at(origin, direction)
        if hit is not None:
            self.choose(hit)
        elif self._pinning.value:
            self._pin(event.client, origin * UNIT, direction)

    def _pin(self, client: viser.ClientHandle | None, origin: F64, direction: F64) -> None:
        splats = self._scene.splats
        if splats is None or self.frozen:
            why = OLD if self.frozen else "there is nothing to pin to now"
            tell(client, "Pin", why, "orange")
            return
        point = splats.hit(origin, direction)
        if point is None:
            tell(client, "Pin", "no tissue there", "orange")
            return
        place = {axis: float(x) for axis, x in zip("xyz", point, strict=True)}
        answer = self._ask(client, "Pin", "add_anchor", place)
        if answer is not None:
            self.choose(int(answer["id"]))

    def choose(self, anchor: int) -> None:
        """Choose an anchor for Remove. The distance is measured to the one that was chosen before."""
        before = self._chosen.value
        for choice, chosen in ((self._other, before), (self._chosen, str(anchor))):
            if chosen not in choice.options:
                self._awaited.add(chosen)
                choice.options = (*choice.options, chosen)
            choice.value = chosen  # type: ignore[misc]  # as above

    def _list_anchors(self, anchors: NDArray[Any] | None) -> None:
        if anchors is None:  # nothing fresh came: what somebody has chosen stays
            self._anchor_rows.content, self._distance.content = _line("nothing new"), ""
            return
        rows = list(anchors)
        self._anchor_rows.content = anchor_table(rows, self._unit)
        by_number = {str(int(row["id"])): row for row in rows}
        self._awaited -= by_number.keys()
        numbers = (NONE, *by_number, *self._awaited)
        for choice in (self._chosen, self._other):
            if choice.options != numbers:
                choice.options = numbers  # viser keeps the choice while it is there
        first, second = (by_number.get(choice.value) for choice in (self._chosen, self._other))
        apart = None if first is None or second is None else distance(first, second, self._unit)
        self._distance.content = "" if apart is None else _line(apart)


def distance(first: Any, second: Any, unit: str) -> str:
    """Return the straight distance of two anchors, rows of `anchors`, in words; a guess is called one."""
    apart = float(np.linalg.norm([first[axis] - second[axis] for axis in "xyz"])) / UNIT
    if not np.isfinite(apart):
        return "Distance: one of them is lost"
    sure = all(map(is_sure_in_space, (first, second)))
    return f"Distance: {apart:.1f} {unit}" + ("" if sure else ", a guess: one is not sure")


def _recording(folder: viser.GuiTextHandle, keep: viser.GuiNumberHandle[float]) -> dict[str, Any]:
    """Arguments of `start_recording`: a new folder each time, on the node's machine."""
    args: dict[str, Any] = {"path": f"{folder.value}_{time.strftime('%Y%m%d_%H%M%S')}"}
    return args | ({"snapshot_seconds": float(keep.value)} if keep.value else {})


def _in_words(answer: Any) -> str:
    if not isinstance(answer, Mapping):
        return "done"
    return ", ".join(f"{key}: {value}" for key, value in answer.items()) or "done"


def status_line(moment: Moment, second: int = 0) -> str:
    """One line: why nothing is shown, or how the node does; below it what it warns of.

    Args:
        second: of any clock. With it the line changes every second, and with each frame: `still` listens.
    """
    status = moment.status
    if moment.problem is not None:
        color, text = "#ff922b", moment.problem
    else:
        latency = status.latency_ms.get("p50") or np.nan
        figures = f"{status.rate_hz:.1f} Hz, {latency:.0f} ms, {status.gaussians} Gaussians"
        if status.rung is not None:
            figures += f", rung {status.rung.number} of 0 to {status.rung.of - 1}"
        color, text = "#51cf66", f"{status.state}: {figures}"
    if status.last_error is not None:
        text += f" ({status.last_error})"
    style = f"padding:0.4em 1em;font-size:0.9em;color:{color}"
    heard = f'data-second="{second}" data-frame="{moment.t_capture_ns}"'
    return f'<div id="sags-status" {heard} style="{style}">{html.escape(text)}</div>' + _warnings(status)


def _warnings(status: Status) -> str:
    """One line for each warning."""
    style = f"margin:0.2em 1em;padding-left:0.5em;font-size:0.9em;border-left:3px solid;color:{ORANGE}"
    return "".join(
        f'<div class="sags-warning" style="{style}">{html.escape(said)} '
        f'<span style="opacity:0.6">({html.escape(code)})</span></div>'
        for code, said in status.warning_codes.items()
    )


def _line(text: str) -> str:
    return f'<div style="padding:0 1em;font-size:0.9em">{html.escape(text)}</div>'


def _overlay_table(overlay: Overlay | None) -> str:
    """Each object of the overlay, and how it does."""
    if overlay is None:
        return _line("none of this node runs here: sags overlay")
    latency = overlay.latency_ms.get("p50")
    said = [f"blank: {overlay.reason}" if overlay.reason else f"{latency or 0:.0f} ms after the camera"]
    for thing in overlay.objects:
        unsure = f"not sure: {thing.unsure}" if thing.unsure else "sure"
        said.append(f"{thing.name}: {f'not drawn: {thing.reason}' if thing.reason else unsure}")
    return "".join(map(_line, said))


def anchor_table(rows: list[Any], unit: str) -> str:
    """Return a table of where each anchor is, how sure it is on its tissue, and which depth is a guess."""
    if not rows:
        return _line("none yet")
    cells = []
    for row in rows:
        place = " ".join(f"{row[axis] / UNIT:.1f}" for axis in "xyz") if np.isfinite(row["x"]) else "lost"
        if np.isfinite(row["x"]) and row["depth_confidence"] < SURE:
            place += ", a guess"
        seen, sure = f"{100 * row['visibility']:.0f} %", f"{100 * row['confidence']:.0f} %"
        values = (int(row["id"]), place, seen, sure)
        cells.append("<tr>" + "".join(f"<td>{value}</td>" for value in values) + "</tr>")
    heads = "".join(f"<th align=left>{head}</th>" for head in ("", f"x y z ({unit})", "seen", "sure"))
    return f'<table style="padding:0 1em;width:100%"><tr>{heads}</tr>{"".join(cells)}</table>'
