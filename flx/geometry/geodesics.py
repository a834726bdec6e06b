"""Straight walks on a surface: the exponential map, exactly, by unfolding one face after another.

Each face is laid into the complex plane: its first corner at 0, its second on the positive real axis. A
walk is straight there, and at an edge it goes on in the plane of the next face (Polthier & Schmies 1998).
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Complex128, Float64, Int

from flx.geometry.arrays import face_areas, length_of
from flx.geometry.topology import edges_of
from flx.types import SurfacePoints

MOST_CROSSINGS = 20_000  # of edges, by one walk


class Unfolding(NamedTuple):
    """The faces of a mesh in the complex plane, and how to go from one to the next."""

    corners: Complex128[Any, "F 3"]
    neighbors: Int[Any, "F 3"]  # the face across the edge opposite to each corner; −1 at a boundary
    turns: Complex128[Any, "F 3"]  # x ↦ turn·x + shift goes from the plane of a face to its neighbour's
    shifts: Complex128[Any, "F 3"]


def unfold(vertices: Float64[Any, "V 3"], faces: Int[Any, "F 3"]) -> Unfolding:
    """Lay the faces of an oriented mesh into the plane. An edge of more than two faces is a boundary."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    base = np.maximum(length_of(b - a), np.finfo(float).tiny)
    along = np.einsum("fx,fx->f", c - a, b - a) / base
    corners = np.stack([np.zeros(len(faces)), base, along + 2j * face_areas(vertices, faces) / base], 1)

    edges = edges_of(faces, len(vertices))
    neighbors = np.full((len(faces), 3), -1)
    turns, shifts = np.ones((len(faces), 3), complex), np.zeros((len(faces), 3), complex)
    for here, there in (edges.inner.T, edges.inner.T[::-1]):
        (f, j), (g, k) = np.divmod(here, 3), np.divmod(there, 3)
        start, end = corners[f, j - 2], corners[f, j - 1]
        onto_end, onto_start = corners[g, k - 2], corners[g, k - 1]  # the neighbour runs along it backwards
        same = faces[f, j - 2] == faces[g, k - 1]
        turn = (onto_end - onto_start) * np.conj(end - start)
        turn /= np.maximum(np.abs(turn), np.finfo(float).tiny)
        neighbors[f, j], turns[f, j] = np.where(same, g, -1), turn
        shifts[f, j] = (onto_start + onto_end) / 2 - turn * (start + end) / 2
    return Unfolding(corners, neighbors, turns, shifts)


def walk(
    unfolding: Unfolding, starts: SurfacePoints, directions: Complex128[Any, "P"], stops: Float64[Any, "S"]
) -> SurfacePoints:
    """Where straight walks are after each distance in `stops` (ascending): point p·S + s is walk p at stop s.

    `directions` are unit numbers in the plane of the starting face. A walk that meets a boundary stays there.
    """
    count = len(directions)
    place = np.einsum("pk,pk->p", unfolding.corners[starts.faces], starts.barycentrics)
    faces, places = np.empty((count, len(stops)), np.int64), np.empty((count, len(stops)), complex)
    active, face, heading = np.arange(count), starts.faces, np.asarray(directions)
    passed, travelled = np.zeros(count, np.int64), np.zeros(count)
    for _ in range(MOST_CROSSINGS):
        corners = unfolding.corners[face]
        side, ahead = _exit(corners, place, heading)
        beyond = unfolding.neighbors[face, side] < 0
        until = np.searchsorted(stops, travelled + ahead, side="right")
        until[beyond] = len(stops)
        reached = until - passed
        rows = np.repeat(np.arange(len(active)), reached)
        stop = passed[rows] + np.arange(len(rows)) - np.repeat(np.cumsum(reached) - reached, reached)
        further = np.minimum(stops[stop] - travelled[rows], ahead[rows])
        faces[active[rows], stop] = face[rows]
        places[active[rows], stop] = place[rows] + heading[rows] * further
        going = until < len(stops)
        if not going.any():
            return SurfacePoints(faces.ravel(), _barycentrics(unfolding, faces.ravel(), places.ravel()))
        active, face, side, ahead = active[going], face[going], side[going], ahead[going]
        turn, shift = unfolding.turns[face, side], unfolding.shifts[face, side]
        place = turn * (place[going] + heading[going] * ahead) + shift
        heading, face = turn * heading[going], unfolding.neighbors[face, side]
        passed, travelled = until[going], travelled[going] + ahead
    raise ValueError(f"a walk crossed {MOST_CROSSINGS} edges; the mesh has needles: remesh it first")


def _cross(x, y):
    return x.real * y.imag - x.imag * y.real


def _exit(corners, place, heading):
    """The side through which a walk leaves its triangle, and the way to it."""
    ahead = np.empty(corners.shape)
    for k in range(3):
        start, edge = corners[:, k - 2], corners[:, k - 1] - corners[:, k - 2]
        facing = _cross(heading, edge)
        leaves = facing > 0
        ahead[:, k] = np.where(leaves, _cross(start - place, edge) / np.where(leaves, facing, 1), np.inf)
    side = ahead.argmin(1)
    return side, np.maximum(np.take_along_axis(ahead, side[:, None], 1)[:, 0], 0)


def _barycentrics(unfolding, faces, places):
    _, b, c = unfolding.corners[faces].T
    third = places.imag / np.maximum(c.imag, np.finfo(float).tiny)
    second = (places.real - third * c.real) / b.real
    weights = np.clip(np.stack([1 - second - third, second, third], 1), 0, 1)
    return weights / weights.sum(1, keepdims=True)
