"""An HTML page that opens anywhere: its images and plots are embedded."""

import base64
from collections.abc import Sequence
from html import escape

import cv2

from sags_node.types import U8

_JPEG_QUALITY = 85

_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #222 }
body { max-width: 1480px; margin: 24px auto; padding: 0 16px }
h1 { font-size: 22px; margin: 0 } h2 { font-size: 18px; margin: 28px 0 8px }
h3 { font-size: 15px; margin: 12px 0 4px } h2.warning { color: #b35c00 }
p { margin: 4px 0; overflow-wrap: anywhere } .quiet { color: #666 }
table { border-collapse: collapse } td, th { padding: 3px 12px 3px 0; text-align: left; vertical-align: top }
td { overflow-wrap: anywhere }
.first { display: flex; align-items: flex-start; flex-wrap: wrap; gap: 12px 24px; margin-top: 16px }
.first video { flex: 1 1 420px; min-width: 0; max-width: 720px; background: #000 }
.first .verdict { flex: 1 1 320px } .verdict th { white-space: nowrap }
.figures { columns: 3 430px; column-gap: 32px } .figures.wide { columns: 2 520px }
.figures table { width: 100%; break-inside: avoid; margin-bottom: 20px }
.figures td { border-top: 1px solid #ddd } .figures th { font-size: 17px; color: #222 }
.figures tr:first-child td { vertical-align: bottom; border-top: 0 }
.figures td { overflow-wrap: break-word } .number { font-variant-numeric: tabular-nums; white-space: nowrap }
.images { display: grid; grid-template-columns: repeat(4, 1fr); gap: 4px }
.plots { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 560px), 1fr)); gap: 8px }
figure { margin: 0 } figcaption { color: #666; font-size: 13px } img { width: 100%; display: block }
@media (max-width: 700px) { .images { grid-template-columns: repeat(2, 1fr) } }
"""


def page(title: str, parts: Sequence[str]) -> str:
    """The HTML page of a title and of parts in HTML."""
    return "\n".join(
        [
            f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<style>{_STYLE}</style></head><body>",
            f"<h1>{escape(title)}</h1>",
            *parts,
            "</body></html>",
        ]
    )


def picture_uri(tile: U8) -> str:
    """An RGB image [H, W, 3] as JPEG, for `src`."""
    return "data:image/jpeg;base64," + base64.b64encode(encoded(".jpg", tile)).decode()


def plot_grid(plots: Sequence[str]) -> str:
    """The HTML of SVG files side by side; empty ones are left out."""
    uris = ["data:image/svg+xml;base64," + base64.b64encode(plot.encode()).decode() for plot in plots if plot]
    shown = [f'<img alt="plot" src="{uri}">' for uri in uris]
    return f'<div class="plots">{"".join(shown)}</div>'


def encoded(suffix: str, picture: U8) -> bytes:
    """The file of an RGB image [H, W, 3], .jpg or .png."""
    options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY] if suffix == ".jpg" else []
    _, data = cv2.imencode(suffix, cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), options)
    return bytes(data)
