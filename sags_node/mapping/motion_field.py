"""Prediction of repeated motion: what followed the last times that the tissue moved as it does now.

The method of analogues (E. N. Lorenz, J. Atmos. Sci. 1969), on the motion of the control nodes: past moments
at which all nodes moved as in the last frames say what comes next. Heart and breathing need no model of their
own for that. The recalled motion is mixed with the last velocities by the weights that would have predicted
the last half second best. Where such moments do not recur, only the last velocity is believed. A HexPlane
field that is learnt beside the video was compared; see `benchmarks/motion_field.md`.
"""

from collections import deque

import numpy as np

from sags_node.types import F32, I64, MotionState

HISTORY = 300  # frames: two breaths at 30 Hz
HORIZONS = 4  # frames ahead
MATCHED = 3  # frames in a row that are compared
NEAREST = 0.3  # s: more recent moments belong to this motion itself; no heart beats faster
LIKENESS = 0.1  # of the motion's energy: a moment that differs by this much more weighs 1/e of another
UNLIKE = float(np.exp(-1 / LIKENESS))  # weight of the hypothesis that nothing moves
MEMORY = 0.93  # factor per frame on what mixing weights and the period are learnt from: half a second
SKILL_MEMORY = 0.97  # the same for the errors of predictions: a second
PRIOR = 0.5  # pulls the mixing weights to equal shares, in energies of one frame's motion
SHARE = 0.3  # prior of each mixing weight: their sum is a little below 1, since tissue slows down
STEADY = 0.8  # factor on the last velocity in a prediction without a memory
LEAST_SKILL = 0.2  # of the motion's energy: a prediction that explains less is not used
LONGEST_GAP = 4  # frames that may be missing: a straight line fills them
LEAST_PROBES = 8  # probed nodes that must be seen: fewer say little of the rest
PERIOD_EVERY = 10  # frames: a period does not change faster
LEAST_WEIGHT = 1e-3  # of a past frame that is used
PROBED = 4  # one of so many nodes is compared and learnt from: a hundred or more stand for all
KNOWN = 0.5  # weight of what was seen around a node: below it nothing is known of it


class MotionField:
    """The motion of control nodes, remembered, and what it says of the next frames."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Forget all motion, when the nodes are others now or have moved unseen."""
        self._count = 0  # frames in the history
        self._places: F32 = np.zeros((0, 0, 3), np.float32)  # [2 HISTORY, M, 3] m
        self._steps: F32 = self._places  # from the frame before
        self._probes: F32 = self._places  # of one in `PROBED` nodes
        self._energy = np.zeros(2 * HISTORY, np.float32)  # of the steps, m^2
        self._period: float | None = None  # s, see `_found_period`
        self._stamp_ns = 0
        self._frame_s = 0.0
        self._eye: F32 = np.zeros(3, np.float32)
        self._bases: deque[F32] = deque(maxlen=HORIZONS)  # newest first: [HORIZONS, 3, M, 3]
        self._mixed: deque[F32] = deque(maxlen=HORIZONS)  # [HORIZONS, M, 3]
        self._normal = np.zeros((HORIZONS, 3, 3))
        self._wanted = np.zeros((HORIZONS, 3))
        self._errors = np.zeros((HORIZONS, 3))  # m^2, running: of the mix, of rest, of the last velocity
        self._lags = np.zeros(2 * HISTORY)  # by frames back: weight of the moments like now
        self._trust = 0.0  # 0..1, running: weight of all such moments

    def recalled(self, motion: F32, seen: F32) -> F32 | None:
        """The motion [M, 3] m of all nodes in this frame, hidden ones too, as it was when the seen ones moved
        like this before; None: they never did, or their motion does not repeat.

        Args:
            motion: [M, 3] m since the last frame, where it is known.
            seen: [M] weight of what was seen around each node.
        """
        nodes = self._places.shape[1]
        if self._period is None:
            return None
        known = np.flatnonzero(seen[:nodes:PROBED] > KNOWN)
        if len(known) < LEAST_PROBES:
            return None
        weights = self._likeness(self._count, motion[:nodes:PROBED], known)
        used = np.flatnonzero(weights > LEAST_WEIGHT)
        if len(used) == 0:
            return None
        prior = np.zeros_like(motion)
        prior[:nodes] = np.tensordot(weights[used], self._steps[used], 1)
        return prior

    def take(self, nodes: F32, seen: F32, t_ns: int, eye: F32) -> None:
        """Add the places [M, 3] m of all nodes at the end of a frame; new nodes come last.

        Args:
            seen: [M] weight of what was seen around each node.
            eye: [3] m, world, the camera's place. Skill is that of the motion across its rays.
        """
        self._eye = eye
        seconds = (t_ns - self._stamp_ns) * 1e-9
        self._stamp_ns = t_ns
        if self._count and len(nodes) > self._places.shape[1]:
            self._grow(nodes)
        missing = 0 if self._frame_s == 0 else round(seconds / self._frame_s) - 1
        if self._count and (seconds <= 0 or missing > LONGEST_GAP or len(nodes) < self._places.shape[1]):
            self.forget()
            self._stamp_ns = t_ns
        if self._count == 0:
            self._places = np.zeros((2 * HISTORY, *nodes.shape), np.float32)
            self._steps = np.zeros_like(self._places)
            self._probes = np.zeros_like(self._steps[:, ::PROBED])
        elif missing <= 0:
            self._frame_s = seconds if self._frame_s == 0 else 0.9 * self._frame_s + 0.1 * seconds
        if self._count:
            before = self._places[self._count - 1].copy()
            for number in range(1, max(missing, 0) + 1):
                share = np.float32(number / (missing + 1))
                self._add(before + share * (nodes - before), np.zeros(len(nodes), np.float32))
        self._add(nodes, seen)

    def forecast(self) -> tuple[F32, float, MotionState] | None:
        """Predict how far [HORIZONS, M, 3] m each node will have moved after 1, 2, ... frames; with the time
        of a frame (s), and how far to believe it. None: too little is known yet."""
        if self._count <= MATCHED or self._frame_s == 0:
            return None
        mixed, rested, steady = self._errors.T
        period = self._period
        trusted = (mixed <= steady) & (period is not None)  # else the last velocity, as without a memory
        moves = np.where(trusted[:, None, None], self._mixed[0], np.float32(STEADY) * self._bases[0][:, 0])
        skill = 1 - np.where(trusted, mixed, steady) / np.maximum(rested, 1e-20)
        skill[rested <= 0] = 0
        frames = int(np.argmin(skill > LEAST_SKILL)) if (skill <= LEAST_SKILL).any() else HORIZONS
        state = MotionState(period, float(max(skill[0], 0.0)), frames * self._frame_s)
        return moves, self._frame_s, state

    # ---- inside --------------------------------------------------------------------------------------------

    @property
    def _nearest(self) -> int:
        """`NEAREST` in frames."""
        return int(np.ceil(NEAREST / self._frame_s))

    def _found_period(self) -> float | None:
        """The period (s) of the motion: most moments like now lie a multiple of it back. None: there is no
        such period."""
        often, total = self._lags, float(self._lags.sum())
        if self._trust < 0.5 or not total > 0:
            return None
        lags = np.arange(len(often))
        peaks = 1 + np.flatnonzero((often[1:-1] >= often[:-2]) & (often[1:-1] > often[2:]))
        longest, most = None, 0.5 * total
        for lag in peaks[often[peaks] > 0.3 * often.max()]:
            near = (np.abs(lags - lag * np.rint(lags / lag)) <= max(1.0, 0.05 * lag)) & (2 * lags > lag)
            # Of two periods that explain as much the longer one is right: it holds whole cycles of the other.
            if often[near].sum() >= most:
                once = near & (2 * lags < 3 * lag)
                longest, most = float((often[once] * lags[once]).sum() / often[once].sum()), often[near].sum()
        return None if longest is None else longest * self._frame_s

    def _grow(self, nodes: F32) -> None:
        """Add new nodes, as if they had always moved as their nearest neighbours did."""
        old = self._places.shape[1]
        far = np.square(nodes[old:, None] - nodes[:old]).sum(2)
        like = np.concatenate([np.arange(old), far.argmin(1)])
        offset = nodes - nodes[like]
        new = like[old:]
        self._places = np.concatenate([self._places, self._places[:, new] + offset[old:]], axis=1)
        self._steps = np.concatenate([self._steps, self._steps[:, new]], axis=1)
        self._probes = np.ascontiguousarray(self._steps[:, ::PROBED])
        self._energy[: self._count] = np.square(self._probes[: self._count]).sum((1, 2))
        self._bases = deque((basis[:, :, like] for basis in self._bases), maxlen=HORIZONS)
        self._mixed = deque((mixed[:, like] for mixed in self._mixed), maxlen=HORIZONS)

    def _add(self, nodes: F32, seen: F32) -> None:
        if self._count == 2 * HISTORY:
            for rows in (self._places, self._steps, self._probes, self._energy):
                rows[:HISTORY] = rows[HISTORY:]
            self._count = HISTORY
        k = self._count
        self._places[k] = nodes
        self._steps[k] = nodes - self._places[k - 1] if k else 0
        self._probes[k] = self._steps[k, ::PROBED]
        self._energy[k] = np.square(self._probes[k]).sum()
        self._count += 1
        self._learn(PROBED * np.flatnonzero(seen[::PROBED] > KNOWN))
        if k >= MATCHED and self._frame_s > 0:
            self._say()

    def _learn(self, known: I64) -> None:
        """Compare what was predicted for this frame with what happened, at the probed nodes [K] seen."""
        if len(known) == 0:
            return
        now = self._count - 1
        for back, (basis, mixed) in enumerate(zip(self._bases, self._mixed, strict=True)):
            if now - 1 - back < 0:
                return
            moved = (self._places[now, known] - self._places[now - 1 - back, known]).ravel()
            parts = basis[back][:, known].reshape(3, -1)
            self._normal[back] = MEMORY * self._normal[back] + parts @ parts.T
            self._wanted[back] = MEMORY * self._wanted[back] + parts @ moved
            off = np.stack([mixed[back, known].ravel() - moved, moved, STEADY * parts[0] - moved])
            errors = np.square(self._across(off.reshape(3, -1, 3), known)).sum((1, 2))
            self._errors[back] = SKILL_MEMORY * self._errors[back] + errors / len(known)

    def _across(self, motion: F32, known: I64) -> F32:
        """What the camera sees of the motion [..., K, 3] of the nodes `known`: that across its rays. Along
        them depth, which is measured anew in each frame, hides by its noise how well motion is predicted."""
        rays = self._places[self._count - 1, known] - self._eye
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), np.float32(1e-9))
        return np.asarray(motion - (motion * rays).sum(-1, keepdims=True) * rays)

    def _say(self) -> None:
        """Predict the next frames from all that is remembered."""
        last = self._count - 1
        nodes = self._places.shape[1]
        frames = np.arange(1, HORIZONS + 1, dtype=np.float32)[:, None, None]
        basis = np.zeros((HORIZONS, 3, nodes, 3), np.float32)
        basis[:, 0] = frames * self._steps[last]
        basis[:, 1] = frames * self._steps[last - 1]
        basis[:, 2] = STEADY * basis[:, 0]
        if self._frame_s > 0 and self._count > MATCHED + HORIZONS + self._nearest:
            followed, trust = self._followed(last)
            basis[:, 2] = followed + np.float32(1 - trust) * basis[:, 2]
        mixed = np.empty((HORIZONS, nodes, 3), np.float32)
        for h in range(HORIZONS):
            pull = PRIOR * float(np.square(basis[h, :, ::PROBED]).sum()) + 1e-15
            shares = np.linalg.solve(
                self._normal[h] + pull * np.eye(3), self._wanted[h] + pull * SHARE
            ).astype(np.float32)
            mixed[h] = np.tensordot(shares, basis[h], 1)
        self._bases.appendleft(basis)
        self._mixed.appendleft(mixed)

    def _followed(self, last: int) -> tuple[F32, float]:
        """How far [HORIZONS, M, 3] m nodes went after moments like this one, weighted by likeness; and the
        sum of the weights, 0..1."""
        nodes = self._places.shape[1]
        weights = self._likeness(last, self._probes[last], None)
        weights = weights[: last - HORIZONS]  # what came after must be known
        used = np.flatnonzero(weights > LEAST_WEIGHT)
        trust = float(weights.sum())
        self._trust = MEMORY * self._trust + (1 - MEMORY) * trust
        self._lags *= MEMORY
        self._lags[last - used] += weights[used]
        if last % PERIOD_EVERY == 0:
            self._period = self._found_period()
        followed = np.zeros((HORIZONS, nodes, 3), np.float32)
        for h in range(HORIZONS if len(used) else 0):
            followed[h] = followed[h - 1] + np.tensordot(weights[used], self._steps[used + 1 + h], 1)
        return followed, trust

    def _likeness(self, newest: int, motion: F32, known: I64 | None) -> F32:
        """Weight [newest] of each past frame, by how alike the nodes moved in it and in those just before.
        The sum is below 1: the hypothesis that nothing moves has a weight, too.

        Args:
            newest: number of the frame that is compared, which need not be in the history yet.
            motion: [P, 3] m, of the probed nodes in that frame.
            known: indices of the probed nodes that count in that frame, None: all; before it, all count.
        """
        first = max(MATCHED, newest - HISTORY)
        weights = np.zeros(newest, np.float32)
        apart = np.zeros(newest - first, np.float32)
        energy = 0.0
        for i in range(MATCHED):
            rows = slice(first - i, newest - i)
            now = self._probes[newest - i] if i else motion
            past, norms = self._probes[rows], self._energy[rows]
            if i == 0 and known is not None:
                now, past = now[known], past[:, known]
                norms = np.square(past).sum((1, 2))
            own = float(np.square(now).sum())
            energy += own
            apart += norms + own - 2 * (past.reshape(len(past), -1) @ now.ravel())
        likeness = np.exp(-np.clip(apart / max(energy, 1e-15) / LIKENESS, 0, 80))
        likeness[newest - self._nearest - first :] = 0
        weights[first:] = likeness / (likeness.sum() + UNLIKE)
        return weights
