"""The faces around chosen vertices, and measures of their shape, to judge moves of those vertices."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int

from flx.geometry.arrays import Rng, area_normals, dot, mark, squared_sides, sum_at, unit_vectors
from flx.geometry.topology import Topology
from flx.types import Faces, Vertices


class Stars:
    """The faces around each of the vertices `centers`, no two of which are adjacent."""

    def __init__(self, vertices: Vertices, faces: Faces, centers: Int[Any, "N"]):
        owner = np.full(len(vertices), -1)  # the star of each vertex that is a centre, else -1
        owner[centers] = np.arange(len(centers))
        owners = np.maximum.reduce([np.take(owner, faces[:, k]) for k in range(3)])
        self.ids = np.flatnonzero(owners >= 0)
        self.faces, self.owners, self.size = faces[self.ids], owners[self.ids], len(centers)
        self.face_normals = area_normals(vertices, self.faces)
        self.normals = unit_vectors(sum_at(self.owners[:, None], self.face_normals, self.size))
        self.centers = centers

    def middles(self, vertices: Vertices) -> Float64[Any, "N 3"]:
        """The mean of each centre's neighbours; the centres must be interior vertices."""
        corners = np.take(vertices, self.faces, 0).sum(1) - vertices[self.centers[self.owners]]
        sums = sum_at(self.owners[:, None], corners, self.size)
        return sums / (2 * np.bincount(self.owners, minlength=self.size))[:, None]

    def random_steps(self, scale: float, rng: Rng) -> Float64[Any, "N 3"]:
        """Random moves of the centres along the surface; `scale` bounds their standard deviations."""
        step = rng.normal(size=(self.size, 3)) * (scale * rng.random(self.size))[:, None]
        return step - dot(step, self.normals)[:, None] * self.normals

    def worst(self, values: Float64[Any, "n"]) -> Float64[Any, "N"]:
        """The largest value among the faces of each star."""
        return largest(self.owners, values, self.size)

    def keep_facing(self, moved: Float64[Any, "V 3"], least: float = 0.5) -> Bool[Any, "N"]:
        """Whether no face of the star turns by more than arccos(`least`)."""
        turn = dot(unit_vectors(self.face_normals), unit_vectors(area_normals(moved, self.faces)))
        return self.worst(-turn) < -least


def largest(owners: Int[Any, "n"], values: Float64[Any, "n"], size: int) -> Float64[Any, "N"]:
    """The largest value of each owner; −∞ for an owner without values."""
    maxima = np.full(size, -np.inf)
    np.maximum.at(maxima, owners, values)
    return maxima


def independent(topo: Topology, candidates: Int[Any, "N"], rank: Int[Any, "N"]) -> Bool[Any, "N"]:
    """Which candidates have a lower rank than all candidates next to them."""
    rank_at = np.full(topo.count, len(candidates))
    rank_at[candidates] = rank
    beaten = np.maximum(*np.take(rank_at, topo.edges.T))
    return ~mark(len(candidates) + 1, beaten)[rank]


def sharpest_cosines(vertices: Vertices, faces: Faces) -> Float64[Any, "F"]:
    """The cosine of each face's smallest angle."""
    sides = np.sort(squared_sides(vertices, faces), axis=0)
    return (sides[1] + sides[2] - sides[0]) / (2 * np.sqrt(sides[1] * sides[2]) + 1e-300)


def longest_sides(vertices: Vertices, faces: Faces) -> Float64[Any, "F"]:
    """The length of each face's longest side."""
    return np.sqrt(squared_sides(vertices, faces).max(0))
