"""Points pinned to the tissue by a user and followed through its deformation.

An anchor moves with the Gaussians around it, also while an instrument hides them: they follow the control
nodes. The image corrects it. Across the ray, the patch of the image that surrounded the anchor at first
is found again, so that it does not drift; along the ray, it keeps its distance to the drawn surface. An
anchor that was out of sight for long is found by what surrounded it (`recall`).
"""

from dataclasses import dataclass, fields, replace

import cv2
import numpy as np

from sags_node.confidence import confidence_of
from sags_node.engine.interface import BEHIND_SURFACE
from sags_node.errors import SagsError
from sags_node.geometry import project, scale_pixels, unproject
from sags_node.mapping.recall import Place, Recall, fits_depth, straightened
from sags_node.model.forecast import points_ahead, reached
from sags_node.types import (
    F32,
    F64,
    I64,
    U8,
    AnchorsAhead,
    AnchorStates,
    Bool,
    Gaussians,
    Observation,
    RenderedView,
    Snapshot,
)
from sags_node.vision.landmarks import RATIO, features_of
from sags_node.vision.pyramid import pyramid_of

MAX_ANCHORS = 256
NEIGHBOURS = 16  # Gaussians that carry an anchor
REACH = 0.005  # m; Gaussians farther than this from an anchor do not carry it
SOFT = 1e-4  # m; Gaussians nearer than this weigh the same
RENEW_BELOW = 0.8  # share of the weight still there: below it new neighbours are taken
RENEWED_PER_FRAME = 8  # anchors; taking neighbours costs a third of a millisecond

POINTING = 4  # px around a pixel in which its depth is looked for: nobody points more exactly
SEEN_RADIUS = 2  # px around the anchor that must be free for it to be fully visible
PATCH_RADIUS = 10  # px
SEARCH_RADIUS = 4  # px, for an anchor that was found in the frame before
SEARCH_GROWTH = 30.0  # px/s since it was found last
MAX_SEARCH_RADIUS = 16  # px
FOUND_AGREEMENT = 0.8  # normalised cross-correlation from which on the patch counts as found
APART = 4  # px: a match farther than this from the best one is another place
CLEARER = RATIO**2  # ratio test on 1 - agreement, a squared distance: the best place to the second best
ALONE_AGREEMENT = 0.9  # needed where nothing else says that it is the place; other tissue reached 0.82
SEARCHED_PER_FRAME = 32  # anchors, in turn
DEPTH_PULL = 0.1  # share of the depth error taken per frame
DEPTH_GATE = 0.05  # of the depth: a larger error is another surface
HALF_LIFE = 2.0  # s without a sight of the patch in which the confidence halves
HALF_WAY = 0.005  # m of motion out of sight in which the confidence halves, too
IN_SIGHT = 0.02  # share of the motion that counts while in sight: the error of optical flow
UNWATCHED = 10.0  # factor on the time while no frame is taken in: nothing carries an anchor then
RECALL_EVERY = 0.5  # s, while an anchor is lost: it costs some milliseconds
REMEMBER_EVERY = 2.0  # s, while no anchor is lost
RECALL_RADIUS = 10  # px, searched around the place that the surrounding tissue predicts
SURE = 0.3  # s: anchors that were found within this time are remembered
LOST = 1.0  # s out of sight, after which an anchor is searched in the whole image
TOLD = 0.2  # s: an anchor is reported lost for at least this long, since clients miss frames

_NOBODY = -1  # in the place of a Gaussian's id
_SIDE = 2 * PATCH_RADIUS + 1


@dataclass(frozen=True, slots=True)
class _Table:
    """One row for each anchor; the arrays are written in place."""

    ids: I64  # [A]
    points: F64  # [A, 3] m, world; NaN: lost
    carriers: I64  # [A, NEIGHBOURS] ids of Gaussians
    weights: F64  # [A, NEIGHBOURS] 0: this carrier is gone, or there never was one
    means: F64  # [A, NEIGHBOURS, 3] m, of the carriers in the last snapshot
    pixels: F64  # [A, 2] px; NaN: behind the camera or lost
    depths: F64  # [A] m, camera z
    visibility: F64  # [A] 0..1
    patches: U8  # [A, _SIDE, _SIDE] gray, around the anchor when it was first seen clearly
    depth_offsets: F64  # [A] m, drawn surface minus anchor at that time; NaN: not seen clearly yet
    agreement: F64  # [A] 0..1, of the patch when it was found last
    unseen: F64  # [A] s since it was found last, and a penalty for the way it was carried since
    searched: I64  # [A] number of the frame in which it was searched last
    found: I64  # [A] number of the frame in which a search found it last
    ages: F64  # [A] s since it was pinned
    depth_confidence: F64  # [A] 0..1, of the depth of its carriers


class Anchors:
    """The anchors of one node. Ids are never reused.

    Args:
        usable: `TissueMask.usable`, to say why a pixel cannot be pinned; None: the whole image is usable.
    """

    def __init__(self, usable: Bool | None = None) -> None:
        self._usable = usable
        self._table = _row(0, np.zeros(3), (np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 3))))
        self._table = _selected(self._table, np.zeros(1, bool))
        self._next_id = 1
        self._frames = 0
        self._stamp_ns: int | None = None  # of the last frame
        self._recall = Recall()
        self._recalled_ns = 0  # stamp of the frame in which it was used last
        self._wanted: dict[int, float | None] = {}  # s ahead, by id; None: by the latency

    def __len__(self) -> int:
        return len(self._table.ids)

    def add_pixel(
        self, u: float, v: float, observation: Observation, snapshot: Snapshot, view: RenderedView,
        size: tuple[int, int] | None = None,
    ) -> int:  # fmt: skip
        """Pin the tissue seen at a pixel (u, v) of the left image; returns the anchor's id.

        Args:
            size: width and height of the image that (u, v) is a pixel of; default: the observation's.

        Raises:
            SagsError: the pixel is outside the image, excluded, on an instrument or without depth, or there
                are too many anchors.
        """
        working = observation.tissue.shape[1], observation.tissue.shape[0]
        width, height = size or working
        if not (-0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5):
            raise SagsError(f"pixel ({u:g}, {v:g}) is outside the left image of {width}x{height} px")
        pixel = scale_pixels(np.array([u, v], np.float64), (width, height), working)
        column, row = np.clip(np.rint(pixel), 0, np.subtract(working, 1)).astype(int).tolist()
        if not observation.tissue[row, column]:
            why = "shows an instrument, or what lies on a lens"
            if self._usable is not None and not self._usable[row, column]:
                why = "lies in a box of vision.tissue.exclude, or outside the camera's own image"
            raise SagsError(f"pixel ({u:g}, {v:g}) {why}, so no tissue is known there; choose another")
        depth = _depth_near(row, column, observation, view)
        if depth <= 0:
            raise SagsError(
                f"there is no depth at pixel ({u:g}, {v:g}) in this frame, or only one borrowed from afar; "
                "choose another"
            )
        point = unproject(observation.camera, pixel, np.array(depth))
        return self.add_point(np.asarray(point), observation, snapshot, view)

    def add_point(self, point: F64, observation: Observation, snapshot: Snapshot, view: RenderedView) -> int:
        """Pin a point [3] (m, world), which may be hidden; returns the anchor's id.

        Raises:
            SagsError: no tissue of the model is near, or there are too many anchors.
        """
        if len(self) >= MAX_ANCHORS:
            raise SagsError(
                f"there are {MAX_ANCHORS} anchors already, the most there can be; remove some first"
            )
        carriers = _carriers(point, snapshot.gaussians)
        if len(carriers[0]) == 0:
            place = ", ".join(f"{x:.4f}" for x in point)
            raise SagsError(
                f"the model has no tissue within {REACH * 1e3:g} mm of ({place}) m, world; choose another "
                "place, or wait until it was in sight for a second"
            )
        anchor_id = self._next_id
        row = _row(anchor_id, point, carriers)
        _carry(row, snapshot.gaussians)
        _look(row, observation, view)
        self._table = _joined(self._table, row)
        self._next_id += 1
        return anchor_id

    def look_ahead(self, anchor_id: int, seconds: float | None) -> None:
        """Report also where the anchor is expected after `seconds`; None: after the latency."""
        self._wanted[anchor_id] = seconds

    def ahead(self, states: AnchorStates, snapshot: Snapshot, latency_s: float) -> AnchorStates:
        """The states, with predicted places of the anchors of `look_ahead`, as far as motion is predicted.

        Args:
            latency_s: recent time from the capture of a frame to the display of it.
        """
        if not self._wanted or snapshot.forecast is None or len(states) == 0:
            return states
        wanted = [self._wanted.get(int(anchor), 0.0) for anchor in states.ids]
        seconds = np.array([reached(snapshot, latency_s if s is None else s) for s in wanted], np.float32)
        points, pixels = states.points.copy(), states.pixels.copy()
        for s in np.unique(seconds[seconds > 0]):
            rows = seconds == s
            points[rows] = points_ahead(snapshot.forecast, points[rows], float(s))
            pixels[rows] = project(snapshot.camera, points[rows].astype(np.float64))[0]
        return replace(states, ahead=AnchorsAhead(seconds, points, pixels))

    def depth_confidence(self, anchor_id: int) -> float:
        """The confidence in the depth of an anchor, which must exist, 0..1."""
        return float(self._table.depth_confidence[self._table.ids == anchor_id][0])

    def remove(self, anchor_id: int) -> None:
        """Forget an anchor.

        Raises:
            SagsError: there is no such anchor.
        """
        kept = self._table.ids != anchor_id
        if kept.all():
            raise SagsError(f"there is no anchor {anchor_id}; it was removed, or never added")
        self._table = _selected(self._table, kept)
        self._recall.keep(self._table.ids)
        self._wanted.pop(anchor_id, None)

    def update(
        self, observation: Observation, snapshot: Snapshot, view: RenderedView, clear: bool = True
    ) -> None:
        """Follow the tissue to the next frame.

        An anchor whose Gaussians are all gone at once, as after a restart of the model, is lost until it is
        recognised.

        Args:
            snapshot: the model at that frame.
            view: that model, drawn for the left eye.
            clear: the image shows well how the tissue moves.
        """
        self._frames += 1
        if len(self):
            ways = _carry(self._table, snapshot.gaussians)
            _look(self._table, observation, view)
            in_sight = clear & (self._table.visibility == 1)
            self._table.unseen[:] += HALF_LIFE / HALF_WAY * np.where(in_sight, IN_SIGHT, 1.0) * ways
            self._find(observation)
            self._find_lost(observation, snapshot, view)

    def age(self, stamp_ns: int, held: bool = False, equal: bool = False) -> None:
        """Let the time pass until a frame captured at `stamp_ns`.

        Args:
            held: the frame is not taken in.
            equal: its image equals that of the frame before, so that the same anchors would be found.
        """
        before, self._stamp_ns = self._stamp_ns, stamp_ns
        passed = 0.0 if before is None else max(0.0, (stamp_ns - before) * 1e-9)
        table = self._table
        table.ages[:] += passed
        found_again = equal & (table.visibility == 1) & (table.found == table.searched)
        table.unseen[~found_again] += UNWATCHED * passed if held else passed

    def states(self) -> AnchorStates:
        """All anchors as they are now."""
        table = self._table
        return AnchorStates(
            ids=table.ids.copy(),
            points=table.points.astype(np.float32),
            pixels=table.pixels.astype(np.float32),
            visibility=table.visibility.astype(np.float32),
            confidence=(table.agreement * 0.5 ** (table.unseen / HALF_LIFE)).astype(np.float32),
            ages=table.ages.astype(np.float32),
            depth_confidence=table.depth_confidence.astype(np.float32),
        )

    def _find(self, observation: Observation) -> None:
        """Search the image for the patches of visible anchors, in turn, and move the anchors there."""
        table = self._table
        seen = np.flatnonzero((table.visibility == 1) & np.isfinite(table.depth_offsets))
        for i in seen[np.argsort(table.searched[seen], kind="stable")][:SEARCHED_PER_FRAME]:
            table.searched[i] = self._frames
            radius = int(min(SEARCH_RADIUS + SEARCH_GROWTH * table.unseen[i], MAX_SEARCH_RADIUS))
            window, tissue = _window(observation, table.pixels[i], PATCH_RADIUS + radius)
            followed = table.unseen[i] < LOST
            found = _match(window, tissue, table.patches[i], carried=followed)
            if found is not None and (followed or found[1] >= ALONE_AGREEMENT):
                shift, table.agreement[i] = found
                table.found[i] = self._frames
                table.pixels[i] += shift - radius
                table.points[i] = unproject(observation.camera, table.pixels[i], table.depths[i])
                table.unseen[i] = 0.0

    def _find_lost(self, observation: Observation, snapshot: Snapshot, view: RenderedView) -> None:
        """Now and then remember what surrounds the anchors that are seen, and look everywhere for those that
        have not been seen for long."""
        table, stamp = self._table, observation.t_capture_ns
        seen = (table.visibility == 1) & (table.unseen < SURE) & np.isfinite(table.depth_offsets)
        lost = (table.unseen > LOST) | (np.isnan(table.points).any(1) & (table.unseen > TOLD))
        period = RECALL_EVERY if lost.any() else REMEMBER_EVERY
        if not (seen.any() or lost.any()) or 0 <= stamp - self._recalled_ns < period * 1e9:
            return
        self._recalled_ns = stamp
        features = features_of(pyramid_of(observation), observation.tissue)
        for place in self._recall.look(features, table.ids[lost]) if lost.any() else []:
            _put_back(table, place, observation, snapshot, view)
        self._recall.remember(
            features, table.ids[seen], table.pixels[seen], table.depths[seen], table.patches[seen]
        )


def _put_back(
    table: _Table, place: Place, observation: Observation, snapshot: Snapshot, view: RenderedView
) -> None:
    """Move an anchor to where it was recognised, if depth and patch agree; else it stays lost."""
    i = int(np.flatnonzero(table.ids == place.id)[0])
    window, tissue = straightened(observation.gray, observation.tissue, place, PATCH_RADIUS + RECALL_RADIUS)
    found = _match(window, tissue, place.patch)
    if found is None:
        return
    shift, agreement = found
    pixel = place.pixel + place.linear @ (shift - RECALL_RADIUS)
    patch = _patch(observation, pixel, PATCH_RADIUS)
    depth = _depth_at(table, i, pixel, observation, view)
    if patch is None or depth is None or not fits_depth(place, depth):
        return
    point: F64 = np.asarray(unproject(observation.camera, pixel, np.array(depth)), np.float64)
    carriers = _carriers(point, snapshot.gaussians)
    if len(carriers[0]) == 0:
        return
    _hold(table, i, carriers)
    table.points[i], table.pixels[i], table.depths[i] = point, pixel, depth
    table.visibility[i], table.agreement[i], table.unseen[i] = 1, agreement, 0
    table.found[i] = table.searched[i]
    table.patches[i] = patch


def _depth_at(
    table: _Table, i: int, pixel: F64, observation: Observation, view: RenderedView
) -> float | None:
    """Camera z (m) of the anchor in row i at a pixel: from the drawn surface or the measured depth. Where
    neither is known: the anchor's own z, if it was carried to that place; None: unknown."""
    column, row = np.rint(pixel).astype(np.intp)
    surface = float(view.depth[row, column]) or float(observation.depth[row, column])
    if surface > 0:
        return surface - float(table.depth_offsets[i])
    carried = np.linalg.norm(table.pixels[i] - pixel) < SEARCH_RADIUS  # NaN: not
    return float(table.depths[i]) if carried and table.depths[i] > 0 else None


def _carry(table: _Table, gaussians: Gaussians) -> F64:
    """Move each anchor by the mean displacement of its Gaussians since the last snapshot; return how far it
    moved [A], m. The confidence in its depth follows from theirs."""
    order = np.argsort(gaussians.ids, kind="stable")  # nearly sorted already: cheap
    ids = np.append(gaussians.ids[order], np.iinfo(np.int64).max)
    places = np.searchsorted(ids, table.carriers)
    alive = (ids[places] == table.carriers) & (table.weights > 0)
    rows = np.append(order, 0)[places]
    table.weights[~alive] = 0
    share = table.weights.sum(1)
    lost = share == 0
    table.unseen[lost & np.isfinite(table.points).all(1)] = 0  # from now on it counts for how long it is lost
    means = gaussians.means[rows].astype(np.float64) if len(gaussians) else table.means
    displacements = (table.weights[..., None] * (means - table.means)).sum(1)
    displacements /= np.where(lost, np.nan, share)[:, None]
    table.points[:] += displacements
    table.means[:] = means
    if gaussians.depth_errors is not None and len(gaussians):
        errors = (table.weights * gaussians.depth_errors[rows]).sum(1) / np.where(lost, np.nan, share)
        table.depth_confidence[:] = np.where(lost, 0, confidence_of(errors))
    table.agreement[lost] = 0
    thin = np.flatnonzero(~lost & (share < RENEW_BELOW))
    for i in thin[np.argsort(share[thin])][:RENEWED_PER_FRAME]:
        _hold(table, i, _carriers(table.points[i], gaussians))
    return np.asarray(np.linalg.norm(np.nan_to_num(displacements), axis=1))


def _look(table: _Table, observation: Observation, view: RenderedView) -> None:
    """Compute each anchor's pixel and visibility; pull it to its distance from the drawn surface."""
    pixels, depths = project(observation.camera, table.points)
    table.pixels[:], table.depths[:] = pixels, depths
    # What lies under tissue, as a vessel does, is not hidden by the tissue that carries it.
    share = table.weights.sum(1, keepdims=True)
    carriers = np.einsum("ak,akc->ac", table.weights, table.means) / np.where(share > 0, share, np.nan)
    own = project(observation.camera, carriers)[1] - depths
    offsets = np.where(np.isnan(table.depth_offsets), own, table.depth_offsets)
    expected = np.asarray(depths + offsets, np.float64)
    table.visibility[:] = _seen(table.pixels, expected, observation.tissue, view.depth)
    drawn = np.zeros(len(depths))
    clear = np.flatnonzero(table.visibility == 1)
    columns, rows = np.rint(table.pixels[clear]).astype(np.intp).T
    drawn[clear] = view.depth[rows, columns]
    for i in clear[np.isnan(table.depth_offsets[clear])]:
        patch = _patch(observation, table.pixels[i], PATCH_RADIUS)
        if patch is not None and drawn[i] > 0:
            table.patches[i] = patch
            table.depth_offsets[i] = drawn[i] - table.depths[i]
            table.unseen[i] = 0.0
    error = drawn - table.depth_offsets - table.depths  # NaN: never seen clearly
    near = (drawn > 0) & (np.abs(error) < DEPTH_GATE * table.depths)
    table.depths[near] += DEPTH_PULL * error[near]
    table.points[near] = unproject(observation.camera, table.pixels[near], table.depths[near])


def _carriers(point: F64, gaussians: Gaussians) -> tuple[I64, F64, F64]:
    """Ids [k], weights [k] (sum 1) and means [k, 3] of the nearest Gaussians within `REACH`."""
    squares = np.square(gaussians.means - point.astype(np.float32)).sum(1)
    count = min(NEIGHBOURS, len(squares))
    rows = np.argpartition(squares, count - 1)[:count] if count else np.zeros(0, np.intp)
    rows = rows[squares[rows] < REACH**2]
    weights = 1 / np.maximum(np.sqrt(squares[rows].astype(np.float64)), SOFT)
    return gaussians.ids[rows], weights / weights.sum(), gaussians.means[rows].astype(np.float64)


def _hold(table: _Table, i: int, carriers: tuple[I64, F64, F64]) -> None:
    """Let the given Gaussians, if there are any, carry the anchor in row i."""
    count = len(carriers[0])
    if count:
        table.carriers[i], table.weights[i] = _NOBODY, 0
        table.carriers[i, :count], table.weights[i, :count], table.means[i, :count] = carriers


def _depth_near(row: int, column: int, observation: Observation, view: RenderedView) -> float:
    """Depth (m) drawn or measured at a pixel, or at the nearest one of tissue within POINTING; 0: unknown."""
    rows, columns = (slice(max(0, at - POINTING), at + POINTING + 1) for at in (row, column))
    drawn, measured = view.depth[rows, columns], observation.depth[rows, columns]
    depth = np.where(drawn > 0, drawn, measured) * observation.tissue[rows, columns]
    y, x = np.nonzero(depth > 0)
    if len(y) == 0:
        return 0.0
    nearest = np.hypot(y + rows.start - row, x + columns.start - column).argmin()
    return float(depth[y[nearest], x[nearest]])


def _row(anchor_id: int, point: F64, carriers: tuple[I64, F64, F64]) -> _Table:
    """The table of one new anchor."""
    table = _Table(
        ids=np.array([anchor_id], np.int64),
        points=point[None].astype(np.float64),
        carriers=np.full((1, NEIGHBOURS), _NOBODY, np.int64),
        weights=np.zeros((1, NEIGHBOURS)),
        means=np.zeros((1, NEIGHBOURS, 3)),
        pixels=np.full((1, 2), np.nan),
        depths=np.zeros(1),
        visibility=np.zeros(1),
        patches=np.zeros((1, _SIDE, _SIDE), np.uint8),
        depth_offsets=np.full(1, np.nan),
        agreement=np.ones(1),
        unseen=np.zeros(1),
        searched=np.zeros(1, np.int64),
        found=np.zeros(1, np.int64),
        ages=np.zeros(1),
        depth_confidence=np.ones(1),
    )
    _hold(table, 0, carriers)
    return table


def _joined(table: _Table, more: _Table) -> _Table:
    names = [field.name for field in fields(_Table)]
    return _Table(**{name: np.concatenate([getattr(table, name), getattr(more, name)]) for name in names})


def _selected(table: _Table, kept: Bool) -> _Table:
    return replace(table, **{field.name: getattr(table, field.name)[kept] for field in fields(_Table)})


def _seen(pixels: F64, depths: F64, tissue: Bool, drawn: F32) -> F64:
    """Share [A] of the pixels around each anchor that show tissue and no surface in front of the anchor's
    own, which is expected at `depths` [A] (m)."""
    height, width = tissue.shape
    around = np.arange(-SEEN_RADIUS, SEEN_RADIUS + 1)
    known: Bool = np.asarray(np.isfinite(pixels).all(1))
    centres = np.rint(np.where(known[:, None], np.clip(pixels, -1e6, 1e6), -1e6)).astype(np.intp)
    rows = centres[:, 1, None, None] + around[:, None]
    columns = centres[:, 0, None, None] + around
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    places = np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)
    surface = drawn[places]
    free = (surface == 0) | (surface > (1 - BEHIND_SURFACE) * depths[:, None, None])
    return np.asarray(np.mean(inside & tissue[places] & free, axis=(1, 2)), np.float64)


def _patch(observation: Observation, pixel: F64, radius: int) -> U8 | None:
    """The gray image around a place, with subpixel precision; None where not all of it is tissue."""
    height, width = observation.tissue.shape
    column, row = (round(float(x)) for x in pixel)
    reach = radius + 1
    if not (reach <= row < height - reach and reach <= column < width - reach):
        return None
    if not observation.tissue[row - reach : row + reach + 1, column - reach : column + reach + 1].all():
        return None
    size = 2 * radius + 1
    return np.asarray(cv2.getRectSubPix(observation.gray, (size, size), (float(pixel[0]), float(pixel[1]))))


def _window(observation: Observation, pixel: F64, radius: int) -> tuple[U8, Bool]:
    """The gray image around a place (subpixel), and where all pixels that it is sampled from are tissue."""
    size = 2 * radius + 1
    gray = cv2.getRectSubPix(observation.gray, (size, size), (float(pixel[0]), float(pixel[1])))
    height, width = observation.tissue.shape
    tissue = np.zeros((size, size), np.bool_)
    left, top = round(float(pixel[0])) - radius, round(float(pixel[1])) - radius
    rows, columns = slice(max(0, top), min(height, top + size)), slice(max(0, left), min(width, left + size))
    inner = observation.tissue[rows, columns]
    tissue[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left] = inner
    if not tissue.all():  # bilinear sampling reaches one pixel farther
        tissue = cv2.erode(tissue.view(np.uint8), np.ones((3, 3), np.uint8)).view(np.bool_)
    return np.asarray(gray, np.uint8), tissue


def _match(window: U8, tissue: Bool, patch: U8, carried: bool = False) -> tuple[F64, float] | None:
    """Find where [2] (x, y) in the window the patch begins (subpixel), and how well it fits, 0..1. None: it
    is not found on tissue, or fits nearly as well elsewhere, as along an edge. In the latter case a `carried`
    patch is taken to be in the middle, if it fits there nearly as well as at the best place."""
    scores: F32 = np.asarray(cv2.matchTemplate(window, patch, cv2.TM_CCOEFF_NORMED))
    if not tissue.all():
        on_tissue = cv2.erode(tissue.view(np.uint8), np.ones((_SIDE, _SIDE), np.uint8))
        inner = slice(PATCH_RADIUS, len(window) - PATCH_RADIUS)
        scores[on_tissue[inner, inner] == 0] = -1
    row, column = np.unravel_index(int(np.argmax(scores)), scores.shape)
    best, middle = float(scores[row, column]), len(scores) // 2
    if best < FOUND_AGREEMENT:
        return None
    fits = float(scores[middle, middle])
    around = scores[max(0, row - 1) : row + 2, max(0, column - 1) : column + 2].copy()
    scores[max(0, row - APART) : row + APART + 1, max(0, column - APART) : column + APART + 1] = -1
    inside = around.shape == (3, 3) and around.min() > -1
    if inside and 1 - best < CLEARER * (1 - float(scores.max())):
        x, y = column + _vertex(around[1]), row + _vertex(around[:, 1])
        return np.array([x, y]), min(best, 1.0)
    if carried and fits >= FOUND_AGREEMENT and 1 - best > CLEARER * (1 - fits):
        return np.array([middle, middle], np.float64), min(fits, 1.0)
    return None


def _vertex(values: F32) -> float:
    """Place of the maximum of the parabola through three values at -1, 0, 1."""
    before, middle, after = (float(value) for value in values)
    curvature = before - 2 * middle + after
    return 0.0 if curvature == 0 else 0.5 * (before - after) / curvature
