"""Plots by matplotlib, which is an extra: `pip install 'sags-node[report]'`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from io import BytesIO, StringIO
from typing import TYPE_CHECKING, Any

from sags_node.errors import UsageError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 100
_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",  # text stays text
    "svg.hashsalt": "sags",  # the same plot is the same file
    "text.parse_math": False,
    "font.size": 8,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#dddddd",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "figure.constrained_layout.use": True,
}


def has_plots() -> bool:
    """Whether matplotlib is installed."""
    return find_spec("matplotlib") is not None


def check_plots() -> None:
    """To be asked before long work whose result is a plot.

    Raises:
        UsageError: matplotlib is not installed.
    """
    if not has_plots():
        raise UsageError("plots need matplotlib, which is not installed: pip install 'sags-node[report]'")


@contextmanager
def new_figure(width: float, height: float) -> Iterator[Figure]:
    """An empty figure of a size in px, to be filled and written within. `check_plots` says what it raises."""
    check_plots()
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(_STYLE):  # whoever else plots in this process keeps their own style
        yield Figure((width / DPI, height / DPI), dpi=DPI)


def as_svg(figure: Figure) -> str:
    """A whole SVG file."""
    file = StringIO()
    figure.savefig(file, format="svg", metadata={"Date": None})
    return file.getvalue()


def as_png(figure: Figure) -> bytes:
    """A whole PNG file."""
    file = BytesIO()
    figure.savefig(file, format="png")
    return file.getvalue()
