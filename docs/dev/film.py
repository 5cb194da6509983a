"""Makes the film on top of README.md: `PYTHONPATH=. python docs/dev/film.py docs/overlay.webp`, some minutes.

The node's pipeline takes the phantom's frames one by one, and the overlay's own code holds a vessel on the
tissue. Beside it is what a rigid overlay shows whose scope is tracked without error. Where the vessel truly
is, the phantom knows: a thin line in both.
"""

import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from benchmarks.quality.deform import Own, seen
from sags_node.clients.overlay import draw as overlay_draw
from sags_node.clients.overlay.draw import Body, Placed, over
from sags_node.clients.overlay.held import HeldObject
from sags_node.clients.overlay.mesh import Mesh
from sags_node.clients.overlay.scene import ObjectSpec
from sags_node.geometry import project
from sags_node.kernels.threads import configure_threads
from sags_node.mapping.budget import StepBudget
from sags_node.phantom.scene import Phantom, PhantomScene
from sags_node.phantom.tissue import vertex_normals
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import open_session
from sags_node.pipeline.warm_up import warm_up
from sags_node.types import F32, F64, I64, U8, Bool, Camera

SECONDS, RATE, FIRST = 10.0, 30, 156  # of the session: two pulls of 5 s; the film is the second one
FRAMES = round(SECONDS * RATE)
PINNED = 15  # frame whose tissue the vessel is made for, and in which it is pinned
QUALITY = 60  # of WebP
EVERY = 2  # frames; the film has 15 images a second
CROP = 40, 80, 500, 448  # px of the left image: columns and rows from, to
SIZE = 460, 368  # px, of each half
SAID = "Held by the tissue", "Rigid, scope tracked"
STRIP = 30  # px, for what is written above
COLOR, OPACITY = (40, 225, 255), 0.85
LINE = 0.7 / 255  # opacity of the line
# The vessel on the gripped loop, from the grip along the loop and across it, mm; and its radius, mm.
TRUNK = ((-27, -1), (-19, -3), (-11, -5), (-3, -6), (6, -4), (14, -1), (22, 2), (31, 3))
BRANCHES = (
    ((-15, -4), (-14, 1), (-15, 6), (-18, 9)),
    ((6, -4), (9, 1), (8, 6), (11, 10)),
    ((-3, -6), (1, -9), (6, -10)),
    ((14, -1), (19, -4), (25, -6)),
)
RADII = 0.8, 0.5  # mm, of the trunk and of a branch
SIDES = 10
SCENE = PhantomScene(seconds=SECONDS, camera_motion="sway")
SESSION = [f"source.seconds:={SECONDS:g}", "source.camera_motion:=sway", "source.loop:=false"]
PLAYED = ["source.pace:=step", "mapping.rung:=3"]  # a rung that two cores hold at 30 Hz
STEPS = 2  # of the mapper, each frame


class Vessel:
    """Tubes that lie on the phantom's tissue."""

    def __init__(self, phantom: Phantom) -> None:
        self._tissue, relief = phantom.tissue, phantom.tissue.relief
        along = relief.grip_axis
        turned = np.stack([along, [-along[1], along[0]]])
        grip = relief.positions[relief.grip][:2]
        self._lines = []
        for number, points in enumerate((TRUNK, *BRANCHES)):
            self._lines.append((grip + 1e-3 * smooth(np.array(points, float)) @ turned, RADII[number > 0]))

    def shape(self, phase: float) -> tuple[F64, I64]:
        """Vertices [V, 3] (m, world) and triangles [T, 3] at a phase 0..1 of the session."""
        surface = self._tissue.vertices(phase)
        normals = vertex_normals(surface)
        vertices, triangles, first = [], [], 0
        for places, radius in self._lines:
            centres, outward = self._at(surface, places), self._at(normals, places)
            outward /= np.linalg.norm(outward, axis=1, keepdims=True)
            ahead = np.gradient(centres, axis=0)
            side = np.cross(outward, ahead)
            side /= np.linalg.norm(side, axis=1, keepdims=True)
            angles = 2 * np.pi * np.arange(SIDES) / SIDES
            thick = 1e-3 * radius * np.linspace(1, 0.6, len(centres))[:, None, None]
            ring = np.cos(angles)[:, None] * side[:, None] + np.sin(angles)[:, None] * outward[:, None]
            vertices.append((centres[:, None] + thick * ring).reshape(-1, 3))
            here = first + np.arange((len(centres) - 1) * SIDES)
            after = here - here % SIDES + (here + 1) % SIDES  # on the same ring
            triangles += [np.stack([here, after, here + SIDES], 1)]
            triangles += [np.stack([after, after + SIDES, here + SIDES], 1)]
            first += len(centres) * SIDES
        return np.concatenate(vertices), np.concatenate(triangles)

    def pins(self, phase: float) -> F64:
        """Six places [6, 3] (m, world) along the trunk."""
        places = self._lines[0][0]
        chosen = places[np.linspace(0, len(places) - 1, 8).astype(int)[1:-1]]
        return self._at(self._tissue.vertices(phase), chosen)

    def _at(self, values: F32, places: F64) -> F64:
        """Values [rows, cols, 3] of the tissue's grid at places [N, 2] (m) of it."""
        relief = self._tissue.relief
        columns = np.interp(places[:, 0], relief.x, np.arange(len(relief.x))).astype(np.float32)
        rows = np.interp(places[:, 1], relief.y, np.arange(len(relief.y))).astype(np.float32)
        return np.asarray(cv2.remap(values, columns[None], rows[None], cv2.INTER_LINEAR)[0], np.float64)


def smooth(points: F64) -> F64:
    """A curve [N, 2] through points [n, 2], a sample each 0.5 mm or so."""
    knots = np.vstack([2 * points[0] - points[1], points, 2 * points[-1] - points[-2]])
    pieces = []
    for a, b, c, d in zip(knots[:-3], knots[1:-2], knots[2:-1], knots[3:], strict=True):
        t = np.linspace(0, 1, int(2 * np.linalg.norm(c - b)), endpoint=False)[:, None]
        pieces.append(
            0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
        )
    return np.vstack([*pieces, points[-1:]])


def rigid(picture: U8, body: Body, camera: Camera, tissue: Bool) -> U8:
    """An image [H, W, 3] with the vessel where it was in space, but for instruments."""
    z, rgba = np.full(picture.shape[:2], np.inf, np.float32), np.zeros((*picture.shape[:2], 4), np.uint8)
    Placed(body, np.eye(4)).draw(camera, z, rgba)
    rgba[~tissue] = 0
    return over(picture, rgba)


def true_rim(camera: Camera, vertices: F64, triangles: I64) -> U8:
    """How much [H, W] of a thin line round the vessel lies on each pixel, where it truly is."""
    times = 4
    mask = np.zeros((times * camera.height, times * camera.width), np.uint8)
    pixels = np.rint(times * (project(camera, vertices)[0] + 0.5) - 0.5).astype(np.int32)
    for triangle in pixels[triangles]:
        cv2.fillConvexPoly(mask, triangle, 255)
    line = np.zeros_like(mask)
    found = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    cv2.drawContours(line, found, -1, 255, times, cv2.LINE_AA)
    return np.asarray(cv2.resize(line, (camera.width, camera.height), interpolation=cv2.INTER_AREA))


def film(advance: Callable[[int], object]) -> Iterator[Image.Image]:
    """Play the session frame by frame; the images of its second pull."""
    session = open_session(None, [*SESSION, *PLAYED])
    config, phantom = session.config, Phantom(SCENE)
    warm_up(config)
    overlay_draw.warm_up()
    configure_threads(config.engine.threads)
    vessel = Vessel(phantom)
    vertices, triangles = vessel.shape(PINNED / FRAMES)
    colors = np.tile(np.array(COLOR, np.float32), (len(triangles), 1))
    body = Body(Mesh(vertices.astype(np.float32), triangles.astype(np.int32), colors), OPACITY, None)
    anchors = [{"place": pin, "at": pin} for pin in vessel.pins(PINNED / FRAMES).tolist()]
    spec = ObjectSpec.model_validate({"file": "vessel.ply", "deform": True, "anchors": anchors})
    pipeline = Pipeline(config, phantom.rig, rate=RATE)
    with ThreadPoolExecutor(1) as worker, session.source as source:
        held = HeldObject(spec, "pin", Own(pipeline), False, 0.0, body, worker)
        for frame in source:
            result = pipeline.process(frame, StepBudget(STEPS))
            seen_frame = seen(result)
            placed = held.placed(seen_frame) if frame.frame_id >= PINNED else None
            worker.submit(int).result()  # what was begun is done, so a run repeats
            advance(frame.frame_id)
            if frame.frame_id < FIRST or frame.frame_id % EVERY:
                continue
            pair, tissue = result.pair, result.observation.tissue
            rim = true_rim(pair.camera, *vessel.shape(frame.frame_id / FRAMES))
            rim = np.where(tissue, LINE * rim, 0)[..., None]
            drawn = overlay_draw.draw(seen_frame, [] if placed is None else [placed])
            halves = over(pair.left, drawn), rigid(pair.left, body, pair.camera, tissue)
            yield page([np.rint(half + rim * (255.0 - half)).astype(np.uint8) for half in halves])


def page(halves: list[U8]) -> Image.Image:
    """Both halves beside each other, with what they are."""
    font, small = ImageFont.load_default(17), ImageFont.load_default(13)
    sheet = Image.new("RGB", (2 * SIZE[0] + 4, SIZE[1] + STRIP), (18, 20, 24))
    write = ImageDraw.Draw(sheet)
    for side, (half, said) in enumerate(zip(halves, SAID, strict=True)):
        at = side * (SIZE[0] + 4)
        sheet.paste(Image.fromarray(half).crop(CROP), (at, STRIP))
        write.text((at + 10, STRIP // 2), said, "white", font, anchor="lm")
        write.text((at + SIZE[0] - 8, STRIP // 2), "line: where it truly is", "#aab", small, anchor="rm")
    return sheet


def main(out: Path) -> None:
    first, *others = film(lambda number: print(f"\r{number + 1} of {FRAMES}", end="", flush=True))
    period = 1000 * EVERY // RATE
    first.save(out, save_all=True, append_images=others, duration=period, loop=0, quality=QUALITY, method=6)
    print(f"\n{out}: {1 + len(others)} images, {out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
