"""How the tissue moves: the observed motion of some Gaussians becomes a motion of all, hidden ones too."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import prange

from sags_node.kernels.jit import PIECE, inlined, kernel, parallel_kernel
from sags_node.model.gaussians import NEIGHBOURS, GaussianModel
from sags_node.types import F32, F64, I32, I64

_SMOOTHING_ROUNDS = 3  # how far, in nodes, motion spreads into hidden tissue per frame
LEAST_SEEN = 0.5  # weight of what was seen around a node: below it nothing is known of it
_LEAST_STIFFNESS = 0.2  # in squared node spacings: draws gradients that little determines to 0
# Largest momentum over the root of the variance: more is damage. Gradients give at most 1.57 (Cauchy-Schwarz
# over both running means), where the variance is far above the smallest float.
STEEPEST = 2.0
INERTIA, CALM = 0.2, 0.05  # how fast momentum and variance follow the gradient
NODE_EPS = 1e-12  # keeps a node that nothing pulls where it is
MIN_CONTRIBUTION = 1e-3  # px: a Gaussian that contributes less moves no node
_NEW_NODE_DISTANCE = 1.5  # in node spacings: farther new tissue gets nodes of its own

Recall = Callable[[F32, F32], F32 | None]  # motion [M, 3] m and the weight [M] behind it -> all nodes' motion


class NodeDeformation:
    """Control nodes spread over the tissue; each Gaussian follows its nearest ones (embedded deformation:
    R. W. Sumner et al., SIGGRAPH 2007). How tissue turns and stretches around a node follows from the motion
    of its neighbours.

    Hundreds of nodes average thousands of noisy per-Gaussian motions, which is what keeps identity: a
    Gaussian stays on its piece of tissue.

    Attributes:
        spacing: m, between nodes.
        nodes: [M, 3] m, where they are now.
        rest: [M, 3] m, where they are most of the time.
        momentum, variance: [M, 3] running means of the gradients of `descend`, and of their squares.
        seen: [M] weight of what was seen of each in the last `follow`.
    """

    def __init__(self, means: F32, count: int) -> None:
        """Place about `count` nodes over `means` [N, 3] m: the centres of occupied cells of a cubic grid."""
        self.spacing = _spacing_for(means, count)
        self._most = 4 * count  # beyond this, new tissue follows the nodes there are
        self.nodes = cell_centres(means, self.spacing)
        self.rest = self.nodes.copy()
        self.momentum = np.zeros_like(self.nodes)
        self.variance = np.zeros_like(self.nodes)
        self._neighbours = self._find_neighbours()
        self.seen = np.zeros(len(self.nodes), np.float32)

    def attach(self, model: GaussianModel, rows: slice) -> None:
        """Let the Gaussians in `rows` follow the nodes."""
        means = model.means[rows]
        if len(means) == 0:
            return
        index, weight, distance = nearest_nodes(means, self.nodes)
        far = distance > _NEW_NODE_DISTANCE * self.spacing
        if far.any() and len(self.nodes) < self._most:
            self._add_nodes(cell_centres(means[far], self.spacing))
            index, weight, _ = nearest_nodes(means, self.nodes)
        model.node_index[rows] = index
        model.node_weight[rows] = weight

    def follow(
        self,
        model: GaussianModel,
        displacements: F32,
        seen: F32,
        recall: Recall = lambda motion, weight: None,
    ) -> None:
        """Move and turn all Gaussians by what was observed.

        Args:
            model: its `means` and `quats` are changed.
            displacements: [N, 3] m, observed where `seen`.
            seen: [N] weight of the observation, 0 = not seen.
            recall: predicts the motion of all nodes from the motion of the seen ones. Its error at the seen
                nodes is spread to the hidden ones.
        """
        motion, weight = _average(displacements, seen, model.node_index, model.node_weight, len(self.nodes))
        self.seen = weight
        hidden = weight <= LEAST_SEEN
        expected = recall(motion, weight) if hidden.any() else None
        if expected is None:
            _spread(motion, weight, self._neighbours, _SMOOTHING_ROUNDS)
        else:
            motion -= expected
            motion[hidden] = 0
            _spread(motion, weight, self._neighbours, _SMOOTHING_ROUNDS)
            motion += expected
        # The motion is that of the middle of what was seen around a node, not of the node itself.
        places, _ = _average(model.means, seen, model.node_index, model.node_weight, len(self.nodes))
        places = np.where(weight[:, None] > LEAST_SEEN, places, self.nodes)
        least = np.float32(_LEAST_STIFFNESS * self.spacing**2)
        gradients = _motion_gradients(places, motion, self._neighbours, least)
        _carry(places, motion, gradients, model.node_index, model.node_weight, model.means, model.quats)
        self.nodes += motion + np.einsum("mab,mb->ma", gradients, self.nodes - places)

    def descend(self, model: GaussianModel, gradients: F32, contribution: F32, step: float) -> None:
        """Move all Gaussians down the loss.

        Args:
            model: its `means` are moved.
            gradients: [N, 3] of the loss by the means.
            contribution: [N] weight of each Gaussian in the image, 0 = not seen.
            step: length of one step, m.
        """
        gradient, _ = _average(
            gradients,
            (contribution > MIN_CONTRIBUTION).astype(np.float32),
            model.node_index,
            model.node_weight,
            len(self.nodes),
        )
        self.momentum += INERTIA * (gradient - self.momentum)
        self.variance += CALM * (gradient * gradient - self.variance)
        size = np.sqrt(self.variance)
        damaged = ~((np.abs(self.momentum) <= STEEPEST * size) & np.isfinite(size))
        self.momentum[damaged] = self.variance[damaged] = size[damaged] = 0
        motion = (-step * self.momentum / (size + NODE_EPS)).astype(np.float32)
        self.nodes += motion
        _skin(motion, model.node_index, model.node_weight, model.means)

    def accompany(self, model: GaussianModel, displacements: F32) -> None:
        """Move the nodes with their Gaussians, which the caller moves by `displacements` [N, 3] m."""
        all_seen = np.ones(len(displacements), np.float32)
        motion, _ = _average(displacements, all_seen, model.node_index, model.node_weight, len(self.nodes))
        self.nodes += motion

    def settle(self, share: float) -> None:
        """Move the places where the tissue rests a share of the way to where it is now."""
        self.rest += np.float32(share) * (self.nodes - self.rest)

    def away(self, index: I32, weight: F32) -> F32:
        """The displacement [N, 3] m of tissue from where it rests, by its nodes [N, 4] and their weights."""
        return np.asarray(np.einsum("nk,nka->na", weight, (self.nodes - self.rest)[index]), np.float32)

    def normals(self, towards: F64) -> F32:
        """The unit normals [M, 3] of the tissue at the nodes, on the side of a place [3] (m, world). Each is
        the normal of the plane through the node's neighbours."""
        around = self.nodes[self._neighbours] - self.nodes[:, None]
        spread = np.einsum("mka,mkb->mab", around, around)
        normals = np.linalg.eigh(spread)[1][:, :, 0]
        away = np.einsum("ma,ma->m", normals, towards.astype(np.float32) - self.nodes) < 0
        normals[away] *= -1
        return np.asarray(normals, np.float32)

    def _add_nodes(self, nodes: F32) -> None:
        """Add nodes. New tissue is taken to be displaced from rest as the tissue next to it."""
        zeros = np.zeros_like(nodes)
        index, weight, _ = nearest_nodes(nodes, self.nodes)
        self.rest = np.concatenate([self.rest, nodes - self.away(index, weight)])
        self.nodes = np.concatenate([self.nodes, nodes])
        self.seen = np.concatenate([self.seen, zeros[:, 0]])
        self.momentum = np.concatenate([self.momentum, zeros])
        self.variance = np.concatenate([self.variance, zeros])
        self._neighbours = self._find_neighbours()

    def _find_neighbours(self) -> I32:
        """[M, 6] nearest other nodes."""
        k = min(6, max(len(self.nodes) - 1, 1))
        return _nearest(self.nodes, self.nodes, k + 1)[0][:, 1:]


def skinned(moves: F32, index: I32, weight: F32, points: F32) -> F32:
    """Return points [N, 3] m, moved by the weighted motion [M, 3] m of their nodes, as a new array."""
    moved = points.copy()
    _skin(np.ascontiguousarray(moves), index, weight, moved)
    return moved


def spread_nodes(means: F32, count: int) -> F32:
    """Choose about `count` places [M, 3] m, spread evenly over points [N, 3] m."""
    return cell_centres(means, _spacing_for(means, count))


def _spacing_for(means: F32, count: int) -> float:
    """Cell size that gives about `count` occupied cells (bisection: the surface may have any shape)."""
    extent = float(np.ptp(means, axis=0).max()) + 1e-5
    low, high = 1e-4 * extent, extent
    for _ in range(20):
        middle = (low * high) ** 0.5
        occupied = len(np.unique(_cells(means, middle)))
        low, high = (middle, high) if occupied > count else (low, middle)
    return high


def cell_centres(means: F32, cell: float) -> F32:
    """The mean of the points in each occupied cell of a cubic grid, [M, 3]."""
    _, inverse, counts = np.unique(_cells(means, cell), return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(inverse, means[:, k]) for k in range(3)], 1)
    return (sums / counts[:, None]).astype(np.float32)


def _cells(means: F32, cell: float) -> I64:
    """The number [N] of the cell of a cubic grid that each point is in: sorting them is twenty times as fast
    as sorting three coordinates."""
    places = np.floor(means / cell).astype(np.int64)
    places -= places.min(axis=0)
    sizes = places.max(axis=0) + 1
    numbers: I64 = (places[:, 0] * sizes[1] + places[:, 1]) * sizes[2] + places[:, 2]
    return numbers


def nearest_nodes(points: F32, nodes: F32) -> tuple[I32, F32, F32]:
    """Find the nearest nodes: indices [N, 4], skinning weights [N, 4], and distance [N] of the nearest one.

    The weights fall off as a Gaussian whose width is the mean distance, so they are smooth and scale-free.
    """
    index, squared = _nearest(points, nodes, NEIGHBOURS)
    weight = np.zeros_like(squared)
    found = min(NEIGHBOURS, len(nodes))
    near = squared[:, :found]
    width = np.float32(1e-12) + np.float32(1.2) * near.mean(1, keepdims=True)
    weight[:, :found] = np.exp((near[:, :1] - near) / width)
    weight /= weight.sum(1, keepdims=True)
    return index, weight, np.sqrt(squared[:, 0])


@parallel_kernel
def _nearest(points: F32, nodes: F32, count: int) -> tuple[I32, F32]:
    """Indices [N, count] of the nearest nodes, nearest first, and squared distances; where there are fewer
    nodes, 0 and infinity."""
    index = np.zeros((len(points), count), np.int32)
    squared = np.full((len(points), count), np.float32(np.inf))
    for i in prange(len(points)):
        _nearest_of(points[i], nodes, index[i], squared[i])
    return index, squared


@kernel
def _nearest_of(point: F32, nodes: F32, index: I32, squared: F32) -> None:
    last = len(index) - 1
    for j in range(len(nodes)):
        d = np.float32(0)
        for k in range(3):
            e = point[k] - nodes[j, k]
            d += e * e
        if d < squared[last]:
            slot = last
            while slot > 0 and squared[slot - 1] > d:
                squared[slot] = squared[slot - 1]
                index[slot] = index[slot - 1]
                slot -= 1
            squared[slot] = d
            index[slot] = j


@kernel
def _average(values: F32, seen: F32, index: I32, weight: F32, nodes: int) -> tuple[F32, F32]:
    """Weighted mean [M, 3] of per-Gaussian values at each node, and the weight [M] behind it.

    Serial on purpose: a third of a millisecond, and the same bits for any number of threads.
    """
    total = np.zeros((nodes, 3), np.float32)
    mass = np.zeros(nodes, np.float32)
    for i in range(len(values)):
        if seen[i] > 0:
            for k in range(NEIGHBOURS):
                w = weight[i, k] * seen[i]
                if not (w >= 0 and w <= 1):
                    continue  # damaged: this Gaussian is removed later
                j = index[i, k]
                mass[j] += w
                for a in range(3):
                    total[j, a] += w * values[i, a]
    for j in range(nodes):
        for a in range(3):
            total[j, a] = total[j, a] / mass[j] if mass[j] > np.float32(LEAST_SEEN) else np.float32(0)
    return total, mass


@kernel
def _spread(motion: F32, mass: F32, neighbours: I32, rounds: int) -> None:
    """Give nodes of which nothing was seen the mean motion of the neighbours that have one."""
    known = mass > np.float32(LEAST_SEEN)
    for _ in range(rounds):
        reached = known.copy()
        for j in range(len(motion)):
            if known[j]:
                continue
            n = 0
            for k in range(neighbours.shape[1]):
                i = neighbours[j, k]
                if known[i]:
                    n += 1
                    for a in range(3):
                        motion[j, a] += motion[i, a]
            if n > 0:
                for a in range(3):
                    motion[j, a] /= n
                reached[j] = True
        known = reached


@kernel
def _motion_gradients(places: F32, motion: F32, neighbours: I32, least: Any) -> F32:
    """Gradient [M, 3, 3] of the motion around each place: least squares over its neighbours, regularised
    towards 0 by `least` (m^2). Row a is the gradient of the motion along axis a."""
    gradients = np.zeros((len(places), 3, 3), np.float32)
    moments, products = np.empty((3, 3), np.float32), np.empty((3, 3), np.float32)
    count = neighbours.shape[1]
    for j in range(len(places)):
        for a in range(3):
            for b in range(3):
                moments[a, b] = least * count if a == b else np.float32(0)
                products[a, b] = np.float32(0)
        for k in range(count):
            i = neighbours[j, k]
            for b in range(3):
                arm = places[i, b] - places[j, b]
                for a in range(3):
                    moments[a, b] += (places[i, a] - places[j, a]) * arm
                    products[a, b] += (motion[i, a] - motion[j, a]) * arm
        _divide(products, moments, gradients[j])
    return gradients


@inlined
def _divide(products: F32, moments: F32, quotient: F32) -> None:
    """quotient = products moments^-1, [3, 3], `moments` symmetric; unchanged where that has no inverse."""
    xx, xy, xz = moments[0, 0], moments[0, 1], moments[0, 2]
    yy, yz, zz = moments[1, 1], moments[1, 2], moments[2, 2]
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    d, e, f = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    determinant = xx * a + xy * b + xz * c
    if determinant > 0:
        scale = np.float32(1) / determinant
        for k in range(3):
            x, y, z = products[k, 0] * scale, products[k, 1] * scale, products[k, 2] * scale
            quotient[k, 0] = x * a + y * b + z * c
            quotient[k, 1] = x * b + y * d + z * e
            quotient[k, 2] = x * c + y * e + z * f


@parallel_kernel
def _carry(
    places: F32, motion: F32, gradients: F32, index: I32, weight: F32, means: F32, quats: F32
) -> None:  # fmt: skip
    for piece in prange(-(-len(means) // PIECE)):
        first = np.int64(piece) * PIECE
        _carry_rows(
            places, motion, gradients, index, weight, means, quats, first, min(first + PIECE, len(means))
        )


@kernel
def _carry_rows(
    places: F32, motion: F32, gradients: F32, index: I32, weight: F32, means: F32, quats: F32,
    first: Any, end: Any,
) -> None:  # fmt: skip
    """Move each Gaussian by the weighted motion of its nodes, and turn it with the tissue around."""
    half = np.float32(0.5)
    for i in range(first, end):
        x = y = z = turn_x = turn_y = turn_z = np.float32(0)
        for k in range(NEIGHBOURS):
            j, w = index[i, k], weight[i, k]
            g = gradients[j]
            dx, dy, dz = means[i, 0] - places[j, 0], means[i, 1] - places[j, 1], means[i, 2] - places[j, 2]
            x += w * (motion[j, 0] + g[0, 0] * dx + g[0, 1] * dy + g[0, 2] * dz)
            y += w * (motion[j, 1] + g[1, 0] * dx + g[1, 1] * dy + g[1, 2] * dz)
            z += w * (motion[j, 2] + g[2, 0] * dx + g[2, 1] * dy + g[2, 2] * dz)
            turn_x += w * (g[2, 1] - g[1, 2])
            turn_y += w * (g[0, 2] - g[2, 0])
            turn_z += w * (g[1, 0] - g[0, 1])
        means[i, 0] += x
        means[i, 1] += y
        means[i, 2] += z
        # A small rotation: half of the curl is the rotation vector, and half of that the quaternion's.
        turn_x, turn_y, turn_z = half * half * turn_x, half * half * turn_y, half * half * turn_z
        q0, q1, q2, q3 = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
        quats[i, 0] = q0 - turn_x * q1 - turn_y * q2 - turn_z * q3
        quats[i, 1] = q1 + turn_x * q0 + turn_y * q3 - turn_z * q2
        quats[i, 2] = q2 + turn_y * q0 + turn_z * q1 - turn_x * q3
        quats[i, 3] = q3 + turn_z * q0 + turn_x * q2 - turn_y * q1


@parallel_kernel
def _skin(motion: F32, index: I32, weight: F32, means: F32) -> None:
    """Move each Gaussian by the weighted motion of its nodes."""
    for i in prange(len(means)):
        for a in range(3):
            s = np.float32(0)
            for k in range(NEIGHBOURS):
                s += weight[i, k] * motion[index[i, k], a]
            means[i, a] += s
