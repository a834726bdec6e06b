"""The two-sided distance between a mesh and its surface, sampled more densely where it is large.

Distances are in units of the widest gap allowed.
"""

from typing import Any, NamedTuple

import igl
import numpy as np
from jaxtyping import Bool, Float64, Int

from flx.geometry.arrays import Lengths, Vectors, area_normals, dot, mark, unit_vectors, vertex_normals
from flx.geometry.remesh.features import features
from flx.geometry.remesh.smoothing import ReferenceSurface
from flx.geometry.remesh.stars import sharpest_cosines
from flx.geometry.topology import any_of, topology
from flx.types import Faces, Triangulation, Vertices

EASY = 0.7  # distance, in allowed gaps, up to which nothing is penalised
# Distances, in allowed gaps, beyond which the surface is also sampled at edge middles, and inside faces.
NEAR, DOUBTFUL = 0.5, 0.8
CLOSE = 0.3  # if the corners and the centroid of a face are closer than this, no point of it is beyond 1
SLOPE_COSINE = np.cos(np.radians(25.0))  # faces that tilt less against their vertex normals hide no gap


def _lattice(n):
    """Barycentric coordinates that are multiples of 1/n; corners included, as not all lie on the surface."""
    return np.array([(i, j, n - i - j) for i in range(n + 1) for j in range(n + 1 - i)]) / n


LATTICE, FINE = _lattice(3), _lattice(6)  # sample points of every face, and of a face beyond `EASY`


class FaceQuality(NamedTuple):
    """How far faces are from the surface, and how sharp their corners are."""

    sags: Float64[Any, "F"]  # largest distance from the surface
    excess: Float64[Any, "F"]  # squared distances beyond `EASY`, averaged and scaled by the size of `LATTICE`
    cosines: Float64[Any, "F"]  # cosines of the smallest angles

    def put(self, rows: Int[Any, "n"], new: "FaceQuality") -> None:
        """Overwrite the values of some faces in place."""
        for values, new_values in zip(self, new, strict=True):
            values[rows] = new_values

    def at(self, rows: Int[Any, "n"] | Bool[Any, "F"]) -> "FaceQuality":
        """The values of some faces."""
        return FaceQuality(*(values[rows] for values in self))


class MeasuredMesh(NamedTuple):
    """A mesh measured against its surface; all arrays are changed in place."""

    vertices: Vertices
    kind: Int[Any, "V"]  # 0 on a face, 1 on a curve, 2 at a corner (see `features`)
    faces: Faces
    quality: FaceQuality
    probes: Float64[Any, "N 3"]  # sample points of the surface
    gaps: Float64[Any, "N"]  # distances of the probes from the mesh
    hits: Int[Any, "N"]  # the closest face of each probe

    @property
    def wide(self) -> Bool[Any, "F"]:
        """Faces that are too far from the surface, or the closest face of a probe that is too far away."""
        return (self.quality.sags > 1) | mark(len(self.faces), self.hits[self.gaps > 1])

    def submesh(self, rows: Int[Any, "f"]) -> tuple["MeasuredMesh", Int[Any, "v"], Int[Any, "n"]]:
        """Some faces as a mesh of its own, with the indices of its vertices and of its probes in this one."""
        inside, local = np.unique(self.faces[rows], return_inverse=True)
        new_index = np.full(len(self.faces), -1)
        new_index[rows] = np.arange(len(rows))
        own_probes = np.flatnonzero(new_index[self.hits] >= 0)
        part = MeasuredMesh(
            self.vertices[inside],
            self.kind[inside],
            local.reshape(-1, 3),
            self.quality.at(rows),
            self.probes[own_probes],
            self.gaps[own_probes],
            new_index[self.hits[own_probes]],
        )
        return part, inside, own_probes


def measure_mesh(mesh: Triangulation, surface: ReferenceSurface, gap: float) -> MeasuredMesh:
    """Copy and measure a mesh; faces that cannot be far from the surface get distance 0."""
    vertices, faces = mesh[0].copy(), mesh[1].copy()
    quality = FaceQuality(np.zeros(len(faces)), np.zeros(len(faces)), sharpest_cosines(vertices, faces))
    doubtful = _doubtful(vertices, faces, surface, gap)
    quality.put(doubtful, measure_faces(vertices, faces[doubtful], surface, gap))
    kind = features(vertices, faces, topology(faces, len(vertices)))[1]
    return MeasuredMesh(vertices, kind, faces, quality, *_probed(vertices, faces, surface, gap))


def measure_faces(vertices: Vertices, faces: Faces, surface: ReferenceSurface, gap: float) -> FaceQuality:
    """The quality of faces, sampled more finely where a first look finds them beyond `EASY`."""
    apart = _distances(vertices, faces, LATTICE, surface) / gap
    sags, excess = apart.max(1), _beyond(apart)
    near = np.flatnonzero(sags > EASY)
    apart = _distances(vertices, faces[near], FINE, surface) / gap
    sags[near], excess[near] = apart.max(1), _beyond(apart)
    return FaceQuality(sags, excess, sharpest_cosines(vertices, faces))


def distances_to_mesh(points: Vectors, vertices: Vertices, faces: Faces) -> tuple[Lengths, Int[Any, "N"]]:
    """The distance of each point from a mesh, in its units, and the closest face."""
    square, face, _ = igl.point_mesh_squared_distance(points, vertices, faces)
    return np.sqrt(np.asarray(square)), np.asarray(face).astype(np.int64)


def _distances(vertices, faces, lattice, surface):
    points = np.einsum("pk,fkc->fpc", lattice, np.take(vertices, faces, 0))
    return surface.distances(points.reshape(-1, 3)).reshape(len(faces), len(lattice))


def _beyond(apart):
    return len(LATTICE) * (np.maximum(apart - EASY, 0) ** 2).mean(1)


def _doubtful(vertices, faces, surface, gap):
    """Tilted faces that may have a point farther than the allowed gap from the surface."""
    leaning = np.flatnonzero(_leaning(vertices, faces))
    corners, local = np.unique(faces[leaning], return_inverse=True)
    apart = surface.distances(vertices[corners])[local.reshape(-1, 3)].max(1)
    apart = np.maximum(apart, surface.distances(vertices[faces[leaning]].mean(1)))
    return leaning[apart > CLOSE * gap]


def _leaning(vertices, faces):
    """Whether a face is tilted against the vertex normal of one of its corners."""
    normals = area_normals(vertices, faces)
    corners = vertex_normals(faces, normals, len(vertices))
    normals = unit_vectors(normals)
    cosines = [dot(normals, np.take(corners, faces[:, k], 0)) for k in range(3)]
    return np.minimum.reduce(cosines) < SLOPE_COSINE


def _probed(vertices, faces, surface, gap):
    """Points of the surface, their distances from a mesh and the closest faces; refined adaptively.

    To the surface's own probes come the middles of edges with an end farther than `NEAR`, then the points of
    faces with a corner or such a middle farther than `DOUBTFUL`.
    """
    probes = [surface.probes]
    measured = [distances_to_mesh(surface.probes, vertices, faces)]
    apart = measured[0][0][: len(surface.vertices)] / gap
    edges = np.unique(surface.face_edges[any_of(apart > NEAR, surface.faces)])
    probes.append(surface.vertices[surface.edges[edges]].mean(1))
    measured.append(distances_to_mesh(probes[-1], vertices, faces))
    halfway = np.zeros(len(surface.edges))
    halfway[edges] = measured[-1][0] / gap
    far = any_of(apart > DOUBTFUL, surface.faces) | any_of(halfway > DOUBTFUL, surface.face_edges)
    corners = np.take(surface.vertices, surface.faces[far], 0)
    probes.append(np.einsum("pk,fkc->fpc", LATTICE, corners).reshape(-1, 3))
    measured.append(distances_to_mesh(probes[-1], vertices, faces))
    gaps, hits = (np.concatenate(each) for each in zip(*measured, strict=True))
    return np.concatenate(probes), gaps / gap, hits
