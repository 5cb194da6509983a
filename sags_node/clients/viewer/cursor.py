"""The depth under the cursor, looked up by the page itself: a browser does not send the cursor's place."""

import base64

import numpy as np

from sags_node.clients.viewer.feed import CONFIDENCE, DEPTH, Moment
from sags_node.clients.viewer.pictures import BAR, COLUMNS, VIEWS
from sags_node.confidence import SURE

STEP = 1e-4  # m per count of a depth in the page
GUESS = 1 << 15  # the bit that marks a depth as not sure; a depth of 0: unknown
# Runs in the page. An image's depth lies behind it as base64 of little-endian uint16.
SCRIPT = """<script>
(() => {
  let at = null;
  const depth = ({ columns, rows, bar, left, width, height, depths, unit }) => {
    const [across, down] = at === null || !at[2].isConnected ? [-1, -1] : [at[0] * columns, at[1] * rows];
    const column = Math.floor(across), row = Math.floor(down), v = (down - row - bar) / (1 - bar);
    if (across < 0 || v < 0 || left[row * columns + column] !== "1") return "point at an image";
    const place = 2 * (Math.floor(v * height) * width + Math.floor((across - column) * width));
    const bytes = atob(depths), steps = bytes.charCodeAt(place) + 256 * bytes.charCodeAt(place + 1);
    const said = ((steps & 0x7fff) / 10).toFixed(1) + " " + unit;
    return steps ? said + (steps >> 15 ? ", a guess" : "") : "not known there";
  };
  const tell = () => {
    const line = document.getElementById("sags-depth"), text = line && "Depth: " + depth(line.dataset);
    if (line && line.textContent !== text) line.textContent = text;
  };
  addEventListener("mousemove", ({ target, offsetX, offsetY }) => {
    const { clientWidth, clientHeight } = target;
    at = target.tagName === "IMG" ? [offsetX / clientWidth, offsetY / clientHeight, target] : null;
    tell();
  });
  new MutationObserver(tell).observe(document, { childList: true, subtree: true });
})();
</script>"""


def depth_line(moment: Moment, view: str, height: int, unit: str) -> str:
    """The HTML line that tells the depth below a sheet of that height (px); empty where no depth is shown."""
    names = VIEWS[view]
    depth, confidence = moment.pictures.get(DEPTH), moment.pictures.get(CONFIDENCE)
    if depth is None or confidence is None or depth.shape != confidence.shape:
        return ""
    steps = np.nan_to_num(depth / STEP, nan=0.0).clip(0, GUESS - 1).round().astype("<u2")
    steps[(confidence < SURE) & (steps > 0)] += GUESS
    columns = min(COLUMNS, len(names))
    rows = -(-len(names) // columns)
    data = {
        "columns": columns,
        "rows": rows,
        "bar": BAR * rows / height,
        "left": "".join(str(int(not name.startswith("Right"))) for name in names),
        "width": depth.shape[1],
        "height": depth.shape[0],
        "unit": unit,
        "depths": base64.b64encode(steps.tobytes()).decode(),
    }
    attributes = " ".join(f'data-{name}="{value}"' for name, value in data.items())
    return f'<div id="sags-depth" style="padding:0 1em;font-size:0.9em" {attributes}>Depth</div>'
