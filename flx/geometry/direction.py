"""Directions along a surface: a unit tangent vector at each vertex, from an axis, curvature or strokes.

It is a field of vectors, not of lines: opposite directions differ. Where there is none, the vector is zero.
It is computed on one triangulation and carried to others by closest points. In between, vectors lie in space,
so nothing depends on frames or numbering. Strokes are extended by the smoothest field: the one that changes
least along edges, each neighbour's vector being transported (the connection Laplacian; Knöppel et al. 2013).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import igl
import numpy as np
from jaxtyping import Complex128, Float64
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.sparse.linalg import splu

from flx.geometry.arrays import area_normals, cross, dot, face_areas, length_of, unit_vectors, vertex_normals
from flx.geometry.sampling import Places, Surface, closest_points, face_normals, locate, positions
from flx.geometry.tangent import TangentFrames, tangent_frames, transports
from flx.types import Triangulation

AXES = ("x", "y", "z")
WORDS = (*AXES, "curvature")  # "curvature": the line along which the surface bends most
STEEP = 0.1  # tangential part of a unit vector below which it is at right angles to the surface, within 6°
BLURRED = 0.5  # length of a mean of unit vectors below which it has no direction
FAR = 0.05  # of the diagonal of a surface: strokes farther away are those of another one
RINGS = 3  # around a vertex, to which a quadric is fitted for its curvature
HOLD = 1e3  # how firmly strokes hold the field; an edge counts 1
FAINT = 1e-9  # the same of no direction at all: decides where no stroke is in sight

Numbers = Complex128[Any, "V"]  # tangent vectors in the frames of their vertices: unit, or 0


class Stroke(NamedTuple):
    """A line drawn on a surface, or a point with a direction."""

    points: Float64[Any, "N 3"]  # in the units of the surface
    direction: Float64[Any, "3"] | None = None  # at all of its points; None: along the line


Direction = str | tuple[Stroke, ...]  # one of `WORDS`, or strokes


def check_direction(direction: Direction, surface: Surface) -> None:
    """Raises ValueError for what gives a surface no direction: strokes that are not on it, an axis that all
    of it faces, curvature where it is flat."""
    normals = face_normals(surface.vertices, surface.faces)
    if direction == "curvature":
        first = normals[length_of(normals).argmax()]
        if (np.abs(normals @ first) > 1 - 1e-6)[length_of(normals) > 0].all():
            raise ValueError("the surface is flat; give an axis or strokes")
    elif isinstance(direction, str):
        if (1 - normals[:, AXES.index(direction)] ** 2 < STEEP**2)[length_of(normals) > 0].all():
            raise ValueError("all of the surface faces along that axis; choose another")
    else:
        for n, stroke in enumerate(direction):
            _check_on(stroke, f"strokes[{n}]", surface, normals)


def _check_on(stroke: Stroke, name: str, surface: Surface, normals: Places) -> None:
    """Raises ValueError for a stroke that is not on the surface, or at right angles to it."""
    low, high = surface.vertices.min(0), surface.vertices.max(0)
    diagonal = float(np.linalg.norm(high - low))
    away = np.maximum(np.maximum(low - stroke.points, stroke.points - high), 0).max(1)
    if (away <= FAR * diagonal).all():  # else there may be no end of samples
        places, vectors = _along(stroke, diagonal / 200)
        hits = closest_points(places, surface.vertices, surface.faces)
        away = length_of(positions(surface.vertices, surface.faces, hits) - places)
        flat = length_of(vectors - dot(vectors, normals[hits.faces])[:, None] * normals[hits.faces])
        if (away <= FAR * diagonal).all() and (flat < STEEP).all():
            raise ValueError(f"{name} is at right angles to the surface; draw it along the surface")
    if (away > FAR * diagonal).any():
        raise ValueError(
            f"{name} is {away.max():.3g} away from the surface, whose diagonal is {diagonal:.3g}; draw it on "
            "the surface, in the units of its file, with points closer together where it bends"
        )


def field_on(direction: Direction, triangulation: Triangulation) -> Numbers:
    """The direction at the vertices of a triangulation of the surface; `check_direction` comes first.

    An axis: its tangential part. Curvature: the line of the greatest principal curvature, smoothed; of its
    two directions, those that make neighbours agree, as far as a field of vectors can: which of the two is
    arbitrary, and where lines turn by half a turn around a point, a seam of opposite vectors remains.
    Strokes: the smoothest extension of each to its component; components without strokes have no direction.
    """
    frames = tangent_frames(triangulation)
    if direction == "curvature":
        return _curvature(triangulation, frames)
    if isinstance(direction, str):
        axis = np.eye(3)[AXES.index(direction)]
        return as_numbers(np.tile(axis, (len(triangulation.vertices), 1)), triangulation, frames, STEEP)
    return _extended(direction, triangulation, frames)


def carried(numbers: Numbers, source: Triangulation, target: Triangulation) -> Complex128[Any, "W"]:
    """A field of directions at the vertices of another triangulation of the surface, by closest points."""
    vectors = as_vectors(numbers, source, tangent_frames(source))
    hits = locate(target.vertices, _normals(target), *source)
    there = np.einsum("pkx,pk->px", vectors[source.faces[hits.faces]], hits.barycentrics)
    return as_numbers(there, target, tangent_frames(target), BLURRED)


def as_numbers(
    vectors: Float64[Any, "V 3"], triangulation: Triangulation, frames: TangentFrames, least: float
) -> Numbers:
    """The directions of the tangential parts of vectors at vertices; 0 where that is shorter than `least`."""
    x, y = _axes(triangulation, frames)
    z = dot(vectors, x) + 1j * dot(vectors, y)
    return _units(z, least)


def as_vectors(numbers: Numbers, triangulation: Triangulation, frames: TangentFrames) -> Float64[Any, "V 3"]:
    """Tangent vectors in space."""
    x, y = _axes(triangulation, frames)
    return numbers.real[:, None] * x + numbers.imag[:, None] * y


def _units(z: Numbers, least: float) -> Numbers:
    return np.where(np.abs(z) < least, 0, z / np.maximum(np.abs(z), np.finfo(float).tiny))


def _normals(triangulation: Triangulation) -> Float64[Any, "V 3"]:
    vertices, faces = triangulation
    return vertex_normals(faces, area_normals(vertices, faces), len(vertices))


def _axes(
    triangulation: Triangulation, frames: TangentFrames
) -> tuple[Float64[Any, "V 3"], Float64[Any, "V 3"]]:
    """The x and y axes of the frames in space: those that fit the directions of all edges best.

    S = Σ_q e_q e^{−iθ(q)} over the edges e_q in the tangent plane; x is along Re S + n × Im S.
    """
    normals, there = _normals(triangulation), frames.neighbors
    edges = triangulation.vertices[there] - triangulation.vertices[:, None]
    weights = np.where(there < 0, 0, frames.directions.conj())
    sums = np.einsum("vkx,vk->vx", edges, weights)
    x = np.ascontiguousarray(sums.real) + cross(normals, np.ascontiguousarray(sums.imag))
    x = unit_vectors(x - dot(x, normals)[:, None] * normals)
    return x, cross(normals, x)


def _smoothest(
    frames: TangentFrames, pulls: Numbers, strengths: Float64[Any, "V"], turns: int = 1
) -> Numbers:
    """The z that minimises Σ_pq |z_p − P_{p←q} z_q|² + Σ_p strengths_p |z_p|² − 2 Re(pulls̄_p z_p), where P is
    a transport to the power `turns`: 1 for vectors, 2 for lines. All edges count alike."""
    count = len(frames.neighbors)
    p, k = np.nonzero(frames.neighbors >= 0)
    q, carry = frames.neighbors[p, k], transports(frames)[p, k] ** turns
    degrees = np.bincount(p, minlength=count)
    own = np.arange(count)
    entries = np.concatenate([degrees + strengths + FAINT, -carry])
    system = coo_array((entries, (np.concatenate([own, p]), np.concatenate([own, q]))), (count, count))
    # It is Hermitian and positive: no pivots are needed.
    options = {"SymmetricMode": True}
    factors = splu(system.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    return factors.solve(pulls.astype(complex))


def _along(stroke: Stroke, spacing: float) -> tuple[Places, Places]:
    """Points along a stroke, at most so far apart, and the unit vector at each."""
    if len(stroke.points) == 1:
        assert stroke.direction is not None
        return stroke.points, unit_vectors(stroke.direction[None])
    places, vectors = [], []
    for a, b in zip(stroke.points[:-1], stroke.points[1:], strict=True):
        count = int(np.ceil(np.linalg.norm(b - a) / spacing))
        places.append(a + (b - a) * ((np.arange(count) + 0.5) / max(count, 1))[:, None])
        vectors.append(np.tile(b - a if stroke.direction is None else stroke.direction, (count, 1)))
    return np.concatenate(places), unit_vectors(np.concatenate(vectors))


def _extended(strokes: Sequence[Stroke], triangulation: Triangulation, frames: TangentFrames) -> Numbers:
    """The smoothest field that follows strokes. They pull at the corners of the faces that they cross."""
    vertices, faces = triangulation
    spacing = float(np.sqrt(face_areas(vertices, faces).mean())) / 2
    drawn = [_along(stroke, spacing) for stroke in strokes]
    places, vectors = (np.concatenate(parts) for parts in zip(*drawn, strict=True))
    hits = closest_points(places, vertices, faces)
    corners, weights = faces[hits.faces].ravel(), hits.barycentrics.ravel()
    x, y = _axes(triangulation, frames)
    each = np.repeat(vectors, 3, 0)
    wanted = weights * _units(dot(each, x[corners]) + 1j * dot(each, y[corners]), STEEP)
    count = len(vertices)
    pulls = np.bincount(corners, wanted.real, count) + 1j * np.bincount(corners, wanted.imag, count)
    z = _smoothest(frames, HOLD * pulls, HOLD * np.bincount(corners, weights, count))
    p, k = np.nonzero(frames.neighbors >= 0)
    links = csr_array((np.ones(len(p)), (p, frames.neighbors[p, k])), (count, count))
    component = connected_components(links, directed=False)[1]
    reached = np.bincount(component, np.abs(pulls)) > 0
    return np.where(reached[component], _units(z, np.finfo(float).tiny), 0)


def _curvature(triangulation: Triangulation, frames: TangentFrames) -> Numbers:
    """Lines of the greatest principal curvature, as squares of numbers, smoothed where both are alike."""
    vertices, faces = triangulation
    first, second, greatest, least, _ = igl.principal_curvature(vertices, faces.astype(np.int64), RINGS)
    bends = np.abs(np.stack([greatest, least]).reshape(2, -1))
    chosen = np.where((bends[0] >= bends[1])[:, None], first, second)
    # How unlike the two are; where the surface is flat, compared with its size, neither counts.
    unlike = np.abs(bends[0] - bends[1]) / (bends.sum(0) + 1 / np.sqrt(face_areas(vertices, faces).sum()))
    lines = as_numbers(np.ascontiguousarray(chosen), triangulation, frames, STEEP) ** 2
    smooth = _smoothest(frames, unlike**2 * lines, unlike**2, turns=2)
    return _agreeing(frames, np.sqrt(_units(smooth, np.finfo(float).tiny)))


def _agreeing(frames: TangentFrames, z: Numbers) -> Numbers:
    """±z, so that neighbours agree along the tree of those edges at which they are most alike."""
    p, k = np.nonzero(frames.neighbors >= 0)
    q = frames.neighbors[p, k]
    same = (z[p].conj() * transports(frames)[p, k] * z[q]).real
    shape = (len(z), len(z))
    tree = minimum_spanning_tree(csr_array((2 - np.abs(same), (p, q)), shape))
    signs, sign_of = np.ones(len(z)), csr_array((np.where(same < 0, -1.0, 1.0), (p, q)), shape)
    roots = np.unique(connected_components(tree, directed=False)[1], return_index=True)[1]
    for root in roots:
        order, parents = breadth_first_order(tree, root, directed=False)
        for vertex in order[1:]:
            signs[vertex] = signs[parents[vertex]] * sign_of[vertex, parents[vertex]]
    return signs * z
