"""Where the points of one surface come from on another: an anchor at each vertex, exact around it.

An anchor is a vertex of the source, an offset from it, and the turn of tangent vectors on the way: where p
has the tangent vector x, the source has offset + turn · x. So one anchor also says where the neighbours of
its vertex would come from, if they came from the same piece of the source: it predicts their anchors.
Everything is intrinsic but for `placed` and `nearest_anchors`, which compare and convert anchors in space.
Complex numbers here are single precision; logs and offsets are in mean vertex radii of their own surface.
"""

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Complex64, Float32, Float64, Int
from scipy.spatial import KDTree

from flx.geometry.arrays import area_normals, cross, dot, unit_vectors, vertex_normals
from flx.geometry.geodesics import Unfolding, unfold
from flx.geometry.tables import one_rings
from flx.geometry.tangent import TangentFrames, tangent_frames
from flx.types import OneRings, SurfacePoints, Triangulation

FAR = np.complex64(1e6)  # the log of a spare slot, where the nearest of a ring is looked for
HOPS = 4  # vertices that an offset passes at most on its way to the nearest one
Space = Float32[Any, "*N 3"]


class Surface:
    """A triangulation with everything that anchors on it need."""

    def __init__(self, triangulation: Triangulation) -> None:
        self.triangulation = triangulation
        self.frames: TangentFrames = tangent_frames(triangulation)
        exact = one_rings(self.frames, slots=1 + self.frames.neighbors.shape[1])
        self.rings: OneRings = OneRings._make(map(_single, exact))
        self.used: Bool[Any, "V K"] = exact.weights > 0
        self.used[:, 0] = True
        self.reachable: Complex64[Any, "V K"] = np.where(self.used, self.rings.logs, FAR)
        nearest = np.abs(self.reachable[:, 1:]).min(1)
        self.certain: Float32[Any, V] = np.square(nearest / 2)  # squared offsets nearest to their vertex
        self.positions: Space = triangulation.vertices.astype(np.float32)
        self.x_axes, self.y_axes = _axes(triangulation, self.frames)

    @property
    def radius(self) -> float:
        """The mean vertex radius."""
        return self.frames.radius

    def __len__(self) -> int:
        return len(self.positions)

    @cached_property
    def unfolding(self) -> Unfolding:
        return unfold(*self.triangulation)

    @cached_property
    def tree(self) -> KDTree:
        return KDTree(self.triangulation.vertices)

    @cached_property
    def wedges(self) -> Int[Any, "V N"]:
        """The corner (3 · face + i) that begins, counter-clockwise, at each neighbour; −1 for none."""
        faces, count = self.triangulation.faces.astype(np.int64), len(self)
        keys = (faces * count + np.roll(faces, -1, axis=1)).ravel()
        order = np.argsort(keys)
        neighbors = self.frames.neighbors
        wanted = np.arange(count)[:, None] * count + np.maximum(neighbors, 0)
        place = np.minimum(np.searchsorted(keys[order], wanted), len(keys) - 1)
        found = (keys[order][place] == wanted) & (neighbors >= 0)
        return np.where(found, order[place], -1)

    @cached_property
    def angles(self) -> Float64[Any, "V N"]:
        """The directions of the neighbours from 0 to 2π, ascending; spare: more."""
        angles = np.angle(self.frames.directions) % (2 * np.pi)
        angles = np.where(angles > 2 * np.pi - 1e-9, 0.0, angles)
        return np.where(self.frames.neighbors < 0, 99.0, angles)

    def points_at(self, vertices: Int[Any, "N"], logs: Complex64[Any, "N"]) -> SurfacePoints:
        """The points with these logs, inside the one-rings of these vertices: the inverse of `corner_logs`.

        A point beyond the ring is moved to its border.
        """
        frames, angle = self.frames, np.angle(logs.astype(complex)) % (2 * np.pi)
        place = np.maximum((self.angles[vertices] <= angle[:, None]).sum(1) - 1, 0)
        # Behind the last edge of a boundary: the nearest point of the nearer of its two edges.
        outside = self.wedges[vertices, place] < 0
        beyond = np.where(outside, angle - self.angles[vertices, place], 0)
        first = outside & (2 * np.pi - angle < beyond)
        beyond = np.where(first, 2 * np.pi - angle, beyond)
        distance = np.abs(logs) * self.radius * np.maximum(np.cos(beyond), 0)
        angle = np.where(first, 0, angle)
        corners = self.wedges[vertices, np.where(first, 0, np.maximum(place - outside, 0))]
        face, i = np.divmod(corners, 3)
        opening = frames.corner_angles[face, i]
        flat = np.clip((angle - frames.corner_starts[face, i]) / frames.scales[vertices], 0, opening)
        sides = self.unfolding.corners[face] - self.unfolding.corners[face, i][:, None]
        rows = np.arange(len(face))
        first, second = np.abs(sides[rows, (i + 1) % 3]), np.abs(sides[rows, (i + 2) % 3])
        along = distance * np.sin(flat) / np.maximum(second * np.sin(opening), 1e-300)
        ahead = np.maximum((distance * np.cos(flat) - along * second * np.cos(opening)) / first, 0)
        excess = np.maximum(along + ahead, 1)
        barycentrics = np.zeros((len(face), 3))
        barycentrics[rows, (i + 1) % 3], barycentrics[rows, (i + 2) % 3] = ahead / excess, along / excess
        barycentrics[rows, i] = 1 - barycentrics.sum(1)
        return SurfacePoints(face, barycentrics)


class Anchors(NamedTuple):
    """Where each of N points comes from on a source."""

    vertices: Int[Any, "*N"]  # the source's vertex that is nearest
    offsets: Complex64[Any, "*N"]  # from there
    turns: Complex64[Any, "*N"]  # unit numbers: from the frame of the point to that of the source's vertex

    def at(self, rows: Any) -> "Anchors":
        return Anchors(*(part[rows] for part in self))

    def moved(self, logs: Complex64[Any, "*N"], step: float) -> "Anchors":
        """Anchors of the points with these logs, in the same pieces; `step` as in `predicted`."""
        return self._replace(offsets=self.offsets + self.turns * logs * np.float32(step))

    def put(self, rows: Any, others: "Anchors") -> None:
        """Replace some, in place."""
        for part, new in zip(self, others, strict=True):
            part[rows] = new


def settled(source: Surface, anchors: Anchors) -> Anchors:
    """The same anchors, each at the vertex nearest to where its offset leads."""
    vertices, offsets, turns = (np.array(part).ravel() for part in anchors)
    active = np.flatnonzero(_squared(offsets) > source.certain[vertices])
    for _ in range(HOPS):
        here = vertices[active]
        slot = _squared(offsets[active, None] - source.reachable[here]).argmin(1)
        active, here, slot = active[slot > 0], here[slot > 0], slot[slot > 0]
        if not len(active):
            break
        back = np.conj(source.rings.transports[here, slot])
        offsets[active] = back * (offsets[active] - source.rings.logs[here, slot])
        turns[active] *= back
        vertices[active] = source.rings.neighbors[here, slot]
    shape = np.shape(anchors.vertices)
    return Anchors(vertices.reshape(shape), offsets.reshape(shape), turns.reshape(shape))


def predicted(
    source: Surface,
    target: Surface,
    anchors: Anchors,
    step: float,
    rows: Int[Any, "n"],
    slots: Int[Any, "n"] | None = None,
) -> Anchors:
    """What vertices of the rows' one-rings say of the rows' anchors.

    Args:
        step: The length of one mean vertex radius of the target in those of the source.
        slots: Which vertex of the ring to ask; all of them unless given: [n, K], the own one first.
    """
    chosen = rows if slots is None else (rows, slots)
    back = np.conj(target.rings.transports[chosen])
    of = anchors.at(target.rings.neighbors[chosen])
    # log_q p = −P log_p q
    offsets = of.offsets - of.turns * back * target.rings.logs[chosen] * np.float32(step)
    return settled(source, Anchors(of.vertices, offsets, of.turns * back))


def seen_from(source: Surface, here: Int[Any, "n"], anchors: Anchors) -> tuple[Anchors, Bool[Any, "n K"]]:
    """Anchors [n, K] from vertices in the rings of `here` [n], brought into the frames of `here`.

    And which of them could be; the others are meaningless.
    """
    same = (source.rings.neighbors[here][:, None] == anchors.vertices[..., None]) & source.used[here][:, None]
    slot = same.argmax(-1)
    transports = source.rings.transports[here[:, None], slot]
    offsets = source.rings.logs[here[:, None], slot] + transports * anchors.offsets
    vertices = np.broadcast_to(here[:, None], slot.shape)
    return Anchors(vertices, offsets, transports * anchors.turns), same.any(-1)


def averaged(
    source: Surface, here: Int[Any, "n"], anchors: Anchors, counted: Bool[Any, "n K"]
) -> tuple[Anchors, Bool[Any, "n"]]:
    """The mean of the counted anchors of each row, and whether there was one, in the ring of `here`."""
    seen, known = seen_from(source, here, anchors)
    weights = (counted & known).astype(np.float32)
    total = np.maximum(weights.sum(1), 1)
    turns = (seen.turns * weights).sum(1)
    turns = np.where(np.abs(turns) > 1e-6, turns / np.maximum(np.abs(turns), 1e-6), 1).astype(np.complex64)
    mean = Anchors(here, (seen.offsets * weights).sum(1) / total, turns)
    return settled(source, mean), weights.any(1)


def placed(source: Surface, anchors: Anchors) -> tuple[Space, Space]:
    """Positions in space, and the direction there of the x axis of each anchor's own frame."""
    x, y = source.x_axes[anchors.vertices], source.y_axes[anchors.vertices]
    offsets, turns = anchors.offsets[..., None], anchors.turns[..., None]
    there = (x * offsets.real + y * offsets.imag) * np.float32(source.radius)
    return source.positions[anchors.vertices] + there, x * turns.real + y * turns.imag


def nearest_anchors(positions: Space, directions: Space, normals: Space, source: Surface) -> Anchors:
    """Anchors at positions in space, whose x axes have these directions; `normals` keep to a wall's side."""
    near: Any = source.tree.query(positions, k=min(8, len(source)))[1]
    agree = np.einsum("nkx,nx->nk", outward(source, near), normals) > 0
    vertices = near[np.arange(len(near)), agree.argmax(1)]
    away = (positions - source.positions[vertices]) / np.float32(source.radius)
    return Anchors(
        vertices, _tangential(source, vertices, away), _unit(_tangential(source, vertices, directions))
    )


def outward(source: Surface, vertices: Int[Any, "*N"]) -> Space:
    """Unit normals at vertices."""
    return np.cross(source.x_axes[vertices], source.y_axes[vertices])


def _tangential(surface: Surface, vertices: Int[Any, "N"], vectors: Space) -> Complex64[Any, "N"]:
    x, y = surface.x_axes[vertices], surface.y_axes[vertices]
    return ((x * vectors).sum(-1) + 1j * (y * vectors).sum(-1)).astype(np.complex64)


def turned_frames(
    target: Surface, rows: Int[Any, "n"], other: Surface, theirs: Int[Any, "n"]
) -> Complex64[Any, "n"]:
    """The unit numbers that take tangent vectors from frames of one surface to those of another near by."""
    return _unit(_tangential(other, theirs, target.x_axes[rows]))


def _unit(numbers: Complex64[Any, "N"]) -> Complex64[Any, "N"]:
    sizes = np.abs(numbers)
    return np.where(sizes > 1e-9, numbers / np.maximum(sizes, 1e-9), 1).astype(np.complex64)


def _squared(numbers: Complex64[Any, "*N"]) -> Float32[Any, "*N"]:
    """|x|², without the square root that `abs` takes."""
    return numbers.real**2 + numbers.imag**2


def _single(array: np.ndarray) -> np.ndarray:
    return array.astype({"f": np.float32, "c": np.complex64, "i": array.dtype}[array.dtype.kind])


def _axes(triangulation: Triangulation, frames: TangentFrames) -> tuple[Space, Space]:
    """The axes of the frames in space: along the first edge, in the plane of the vertex's mean normal."""
    vertices, faces = triangulation
    normals = vertex_normals(faces, area_normals(vertices, faces), len(vertices))
    first = vertices[np.maximum(frames.neighbors[:, 0], 0)] - vertices
    x = unit_vectors(first - normals * dot(first, normals)[:, None])
    return x.astype(np.float32), cross(normals, x).astype(np.float32)
