"""How far a mesh is from its surface, and the surface from the mesh: measured closely where it is far.

Distances are in gaps: 1 is the widest gap allowed.
"""

from typing import Any, NamedTuple

import igl
import numpy as np
from jaxtyping import Bool, Float64, Int

from flx.geometry.arrays import area_normals, dot, unit_vectors, vertex_normals
from flx.geometry.remesh.features import features
from flx.geometry.remesh.smoothing import Surface
from flx.geometry.remesh.stars import sharpest_cosines
from flx.geometry.topology import any_of, mark, topology
from flx.types import Triangulation

EASY = 0.7  # what is closer is close enough
NEAR, DOUBTFUL = 0.5, 0.8  # the surface is measured closer where it is farther off
CLOSE = 0.3  # where corners and centroid of a face are closer, no point of it is beyond 1
SLOPE = np.cos(np.radians(25.0))  # faces that lean less against their corners' normals hide no gap


def _lattice(n):
    """Barycentric coordinates that are multiples of 1/n: corners too, since not all have landed."""
    return np.array([(i, j, n - i - j) for i in range(n + 1) for j in range(n + 1 - i)]) / n


LATTICE, FINE = _lattice(3), _lattice(6)  # where a face is measured, and one that is nearly too far off


class Shapes(NamedTuple):
    """What is wrong with faces."""

    sags: Float64[Any, "F"]  # how far they are from the surface at most
    excess: Float64[Any, "F"]  # how far beyond `EASY` on the whole, squared
    cosines: Float64[Any, "F"]  # of the sharpest angles

    def put(self, rows: Int[Any, "n"], others: "Shapes") -> None:
        for mine, new in zip(self, others, strict=True):
            mine[rows] = new

    def at(self, rows: Int[Any, "n"] | Bool[Any, "F"]) -> "Shapes":
        return Shapes(*(mine[rows] for mine in self))


class Fit(NamedTuple):
    """A mesh measured against its surface; all arrays are changed in place."""

    vertices: Float64[Any, "V 3"]
    kind: Int[Any, "V"]  # how free they are, see `features`
    faces: Int[Any, "F 3"]
    shapes: Shapes
    probes: Float64[Any, "N 3"]  # points of the surface
    gaps: Float64[Any, "N"]  # how far they are from the mesh
    hits: Int[Any, "N"]  # and from which face

    @property
    def wide(self) -> Bool[Any, "F"]:
        """Faces that are too far from the surface, or have a point of it too far from them."""
        return (self.shapes.sags > 1) | mark(len(self.faces), self.hits[self.gaps > 1])

    def cut(self, rows: Int[Any, "f"]) -> tuple["Fit", Int[Any, "v"], Int[Any, "n"]]:
        """Some faces with vertices of their own; which vertices these were, and which probes are theirs."""
        inside, local = np.unique(self.faces[rows], return_inverse=True)
        place = np.full(len(self.faces), -1)
        place[rows] = np.arange(len(rows))
        asked = np.flatnonzero(place[self.hits] >= 0)
        part = Fit(
            self.vertices[inside],
            self.kind[inside],
            local.reshape(-1, 3),
            self.shapes.at(rows),
            self.probes[asked],
            self.gaps[asked],
            place[self.hits[asked]],
        )
        return part, inside, asked


def fit_of(mesh: Triangulation, surface: Surface, gap: float) -> Fit:
    """A copy of the mesh, measured; faces that cannot be far from the surface count as on it."""
    vertices, faces = mesh[0].copy(), mesh[1].copy()
    shapes = Shapes(np.zeros(len(faces)), np.zeros(len(faces)), sharpest_cosines(vertices, faces))
    doubtful = _doubtful(vertices, faces, surface, gap)
    shapes.put(doubtful, shapes_of(vertices, faces[doubtful], surface, gap))
    kind = features(vertices, faces, topology(faces, len(vertices)))[1]
    return Fit(vertices, kind, faces, shapes, *_probed(vertices, faces, surface, gap))


def shapes_of(vertices: Float64[Any, "V 3"], faces: Int[Any, "F 3"], surface: Surface, gap: float) -> Shapes:
    """What is wrong with faces."""
    apart = _distances(vertices, faces, LATTICE, surface) / gap
    sags, excess = apart.max(1), _beyond(apart)
    near = np.flatnonzero(sags > EASY)
    apart = _distances(vertices, faces[near], FINE, surface) / gap
    sags[near], excess[near] = apart.max(1), _beyond(apart)
    return Shapes(sags, excess, sharpest_cosines(vertices, faces))


def gaps_of(
    points: Float64[Any, "N 3"], vertices: Float64[Any, "V 3"], faces: Int[Any, "F 3"]
) -> tuple[Float64[Any, "N"], Int[Any, "N"]]:
    """How far points are from a mesh, as a length, and which face is the closest."""
    square, face, _ = igl.point_mesh_squared_distance(points, vertices, faces)
    return np.sqrt(np.asarray(square)), np.asarray(face).astype(np.int64)


def _distances(vertices, faces, lattice, surface):
    points = np.einsum("pk,fkc->fpc", lattice, np.take(vertices, faces, 0))
    return surface.distances(points.reshape(-1, 3)).reshape(len(faces), len(lattice))


def _beyond(apart):
    return len(LATTICE) * (np.maximum(apart - EASY, 0) ** 2).mean(1)


def _doubtful(vertices, faces, surface, gap):
    """Leaning faces of which a point may be beyond 1."""
    leaning = np.flatnonzero(_leaning(vertices, faces))
    corners, local = np.unique(faces[leaning], return_inverse=True)
    apart = surface.distances(vertices[corners])[local.reshape(-1, 3)].max(1)
    apart = np.maximum(apart, surface.distances(vertices[faces[leaning]].mean(1)))
    return leaning[apart > CLOSE * gap]


def _leaning(vertices, faces):
    """Which faces lean against the normal of a corner."""
    normals = area_normals(vertices, faces)
    corners = vertex_normals(faces, normals, len(vertices))
    normals = unit_vectors(normals)
    return np.minimum.reduce([dot(normals, np.take(corners, faces[:, k], 0)) for k in range(3)]) < SLOPE


def _probed(vertices, faces, surface, gap):
    """The surface's probes, and more where these are far from a mesh; how far; the closest faces.

    More are the middles of edges, and then the points of faces with one that is nearly too far off.
    """
    probes = [surface.probes]
    found = [gaps_of(surface.probes, vertices, faces)]
    apart = found[0][0][: len(surface.vertices)] / gap
    edges = np.unique(surface.face_edges[any_of(apart > NEAR, surface.faces)])
    probes.append(surface.vertices[surface.edges[edges]].mean(1))
    found.append(gaps_of(probes[-1], vertices, faces))
    halfway = np.zeros(len(surface.edges))
    halfway[edges] = found[-1][0] / gap
    far = any_of(apart > DOUBTFUL, surface.faces) | any_of(halfway > DOUBTFUL, surface.face_edges)
    corners = np.take(surface.vertices, surface.faces[far], 0)
    probes.append(np.einsum("pk,fkc->fpc", LATTICE, corners).reshape(-1, 3))
    found.append(gaps_of(probes[-1], vertices, faces))
    gaps, hits = (np.concatenate(each) for each in zip(*found, strict=True))
    return np.concatenate(probes), gaps / gap, hits
