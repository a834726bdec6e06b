"""The faces around some vertices, and how well shaped they are: what moving one vertex can spoil."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int

from flx.geometry.arrays import area_normals, dot, sum_at, unit_vectors
from flx.geometry.topology import mark


class Stars:
    """The faces around each of some vertices, no two of them adjacent."""

    def __init__(
        self,
        vertices: Float64[Any, "V 3"],
        faces: Int[Any, "F 3"],
        centers: Int[Any, "N"],
    ):
        self.owner = np.full(len(vertices), -1)  # the star of each of the mesh's vertices that is a centre
        self.owner[centers] = np.arange(len(centers))
        owners = np.maximum.reduce([np.take(self.owner, faces[:, k]) for k in range(3)])
        self.ids = np.flatnonzero(owners >= 0)
        self.faces, self.owners, self.size = faces[self.ids], owners[self.ids], len(centers)
        self.face_normals = area_normals(vertices, self.faces)
        self.normals = unit_vectors(sum_at(self.owners[:, None], self.face_normals, self.size))
        self.centers = centers

    def middles(self, vertices: Float64[Any, "V 3"]) -> Float64[Any, "N 3"]:
        """The mean of each centre's neighbours, where its faces close."""
        corners = np.take(vertices, self.faces, 0).sum(1) - vertices[self.centers[self.owners]]
        sums = sum_at(self.owners[:, None], corners, self.size)
        return sums / (2 * np.bincount(self.owners, minlength=self.size))[:, None]

    def worst(self, values: Float64[Any, "n"]) -> Float64[Any, "N"]:
        """The largest of the values of each star's faces."""
        return largest(self.owners, values, self.size)

    def keep_facing(self, moved: Float64[Any, "V 3"], least: float = 0.5) -> Bool[Any, "N"]:
        """Whether no face of the star turns by more than arccos(`least`)."""
        turn = dot(unit_vectors(self.face_normals), unit_vectors(area_normals(moved, self.faces)))
        return self.worst(-turn) < -least


def largest(owners: Int[Any, "n"], values: Float64[Any, "n"], size: int) -> Float64[Any, "N"]:
    """The largest of the values of each owner; −∞ for who owns none."""
    found = np.full(size, -np.inf)
    np.maximum.at(found, owners, values)
    return found


def independent(
    edges: Int[Any, "E 2"], count: int, asked: Int[Any, "N"], rank: Int[Any, "N"]
) -> Bool[Any, "N"]:
    """Which of the vertices asked have a lower rank than all their neighbours."""
    place = np.full(count, len(asked))
    place[asked] = rank
    later = np.maximum(*np.take(place, edges.T))
    return ~mark(len(asked) + 1, later)[rank]


def sharpest_cosines(vertices: Float64[Any, "V 3"], faces: Int[Any, "F 3"]) -> Float64[Any, "F"]:
    """The cosine of each face's smallest angle."""
    a, b, c = (np.take(vertices, faces[:, k], 0) for k in range(3))
    sides = np.sort([dot(u, u) for u in (b - a, c - b, a - c)], axis=0)
    return (sides[1] + sides[2] - sides[0]) / (2 * np.sqrt(sides[1] * sides[2]) + 1e-300)


def longest_sides(vertices: Float64[Any, "V 3"], faces: Int[Any, "F 3"]) -> Float64[Any, "F"]:
    """The length of each face's longest side."""
    a, b, c = (np.take(vertices, faces[:, k], 0) for k in range(3))
    return np.sqrt(np.maximum.reduce([dot(u, u) for u in (b - a, c - b, a - c)]))
