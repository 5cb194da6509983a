"""A page that opens anywhere: its pictures and plots are in it."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape

import cv2

from sags_node.types import U8

_JPEG_QUALITY = 85

_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #222 }
body { max-width: 1480px; margin: 24px auto; padding: 0 16px }
h1 { font-size: 22px; margin: 0 } h2 { font-size: 17px; margin: 28px 0 8px } p { margin: 4px 0 }
table { border-collapse: collapse } td, th { padding: 3px 12px 3px 0; text-align: left; vertical-align: top }
table.figures td { border-top: 1px solid #ddd } .number { font-variant-numeric: tabular-nums }
table.pictures img { width: 100%; display: block } table.pictures td { padding: 2px; width: 25% }
.plots { display: grid; grid-template-columns: repeat(auto-fit, minmax(520px, 1fr)); gap: 8px }
.quiet { color: #666 }
h3 { font-size: 15px; margin: 12px 0 4px; color: #b35c00 }
.plots img { width: 100% }
"""


def page(title: str, parts: Sequence[str]) -> str:
    """HTML of a title and parts in HTML."""
    return "\n".join(
        [
            f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>',
            f"<style>{_STYLE}</style></head><body>",
            f"<h1>{escape(title)}</h1>",
            *parts,
            "</body></html>",
        ]
    )


def picture_uri(tile: U8) -> str:
    """An RGB picture [H, W, 3] as JPEG, for `src`."""
    return "data:image/jpeg;base64," + base64.b64encode(encoded(".jpg", tile)).decode()


def svg_uri(plot: str) -> str:
    """An SVG file for `src`."""
    return "data:image/svg+xml;base64," + base64.b64encode(plot.encode()).decode()


def encoded(suffix: str, picture: U8) -> bytes:
    """The file of an RGB picture [H, W, 3], .jpg or .png."""
    options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY] if suffix == ".jpg" else []
    _, data = cv2.imencode(suffix, cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), options)
    return bytes(data)
