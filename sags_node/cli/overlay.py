"""`sags overlay`: meshes held by the tissue, over the live image."""

from typing import Any

import click
from rich.markup import escape

from sags_node.cli.launching import as_json, force_option, path_option, positive, shown
from sags_node.cli.node_options import both_options, run_dir_option
from sags_node.terminal import text
from sags_node.terminal.console import console, show


class Ahead(click.ParamType["float | str"]):
    """Milliseconds, or `auto`."""

    name = "MS|auto"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float | str:
        from sags_node.messaging.requests import MAX_AHEAD_MS

        if value == "auto":
            return "auto"
        try:
            ms = float(value)
        except ValueError:
            ms = -1.0
        if not 0 <= ms <= MAX_AHEAD_MS:
            self.fail(f"{value!r}: give 0 to {MAX_AHEAD_MS:g} milliseconds, or auto", param, ctx)
        return ms


@click.command()
@both_options
@path_option(
    "--scene",
    metavar="FILE.yaml",
    help="Meshes, points and labels, and the anchors that hold them; default: a built-in target.",
)
@click.option(
    "--pin", type=(float, float), metavar="U V", help="Pixel of the target; default: middle of tissue."
)
@click.option("--repin", is_flag=True, help="Pin again where it was after the model was started anew.")
@shown("--max-age", type=positive, default=0.5, help="Seconds after which an overlay is blanked.")
@click.option(
    "--show-latency", is_flag=True, help="Write the time from capture to overlay into the left eye's image."
)
@click.option(
    "--ahead",
    type=Ahead(),
    default=0.0,
    help="Draw it where tissue is expected so long after the frame; not for tips of instruments. auto: "
    "when it is published.",
)
@shown("--own-ns", default="overlay", help="Namespace of what is published here.")
@run_dir_option
@click.option("--seconds", type=positive, help="Stop after so long; default: Ctrl-C.")
@path_option("-o", "--out", "--save", "save", help="Write what is shown: .mp4, or .png.")
@path_option(
    "--layers",
    metavar="FILE",
    help="Keep what is drawn, without the video: costs the node nothing. sags demo makes its video of it.",
)
@force_option
@as_json
def overlay(json_out: bool, **options: Any) -> None:
    """Publish geometry held by the tissue, for both eyes.

    It is tested against the depth of the tissue, hidden behind instruments, and blank as soon as anything it
    needs is stale. The node may be started later and restarted. docs/overlay.md describes the scene file,
    also its forbidden zones, docs/wire.md what is published.
    """
    from sags_node.clients.overlay.run import OverlayOptions, run_overlay

    def tell(said: str) -> None:
        console.print(escape(said), soft_wrap=True)

    summary = run_overlay(OverlayOptions(**options), tell)
    show(summary if json_out else text.overlay_table(summary))
