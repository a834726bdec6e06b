"""Triangulated copies of a textured mesh, and how points of the mesh look from a copy's vertices.

The work of one process of a pool: `begin` hands over the mesh once, `make_copy` takes a seed.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Complex64

from flx.geometry.raster import CHUNK
from flx.geometry.remesh.remesh import remesh
from flx.geometry.sampling import ring_points, surface_colors, transfer
from flx.geometry.tables import mesh_tables
from flx.geometry.tangent import TangentFrames, corner_logs, tangent_frames
from flx.types import MeshTables, Queries, RingSamples, SurfacePoints, TexturedMesh, Triangulation


class Copy(NamedTuple):
    """One triangulation of the surface, its gather tables, and colours sampled in its one-rings."""

    triangulation: Triangulation
    tables: MeshTables
    rings: RingSamples


def make_copy(mesh: TexturedMesh, vertices: int, samples: int, slots: int, seed: int) -> Copy:
    """Remesh to `vertices`, build the tables and sample `samples` colours in every one-ring.

    Same seed, same bits. Raises ValueError where the mesh cannot be triangulated so or a ring has more than
    `slots` slots.
    """
    triangulation = remesh(mesh.vertices, mesh.faces, vertices, seed)
    tables = mesh_tables(triangulation, slots=slots, seed=seed)
    return Copy(triangulation, tables, sample_rings(mesh, triangulation, samples, seed))


def sample_rings(mesh: TexturedMesh, triangulation: Triangulation, samples: int, seed: int) -> RingSamples:
    """Colours of `mesh` at points uniform by area in each one-ring of the copy."""
    points, logs = points_in_rings(triangulation, samples, np.random.default_rng(seed))
    hits = transfer(points, triangulation.vertices, triangulation.faces, mesh.vertices, mesh.faces)
    return RingSamples(logs, surface_colors(mesh, hits).reshape(*logs.shape, 3))


def points_in_rings(
    triangulation: Triangulation, samples: int, rng: np.random.Generator
) -> tuple[SurfacePoints, Complex64[Any, "V S"]]:
    """Points uniform by area in each one-ring, those of vertex v from v·samples on, and how v sees them."""
    points, corners = ring_points(triangulation, samples, rng)
    frames, logs = tangent_frames(triangulation), np.empty(corners.size, np.complex64)
    for start in range(0, len(logs), CHUNK):  # the logs of all corners would be most of a worker's memory
        part = slice(start, start + CHUNK)
        seen = corner_logs(frames, triangulation, points.faces[part], points.barycentrics[part])
        logs[part] = np.take_along_axis(seen, corners.reshape(-1, 1)[part], axis=1)[:, 0]
    return points, logs.reshape(corners.shape)


def queries(mesh: TexturedMesh, points: SurfacePoints, triangulation: Triangulation) -> Queries:
    """Points of the mesh as the decoder is asked for them: seen from the corners of a copy's faces."""
    hits = transfer(points, mesh.vertices, mesh.faces, triangulation.vertices, triangulation.faces)
    return queries_at(hits, triangulation, tangent_frames(triangulation))


def queries_at(hits: SurfacePoints, triangulation: Triangulation, frames: TangentFrames) -> Queries:
    """The same, for points that lie on the copy already."""
    logs = corner_logs(frames, triangulation, hits.faces, hits.barycentrics)
    return Queries(
        triangulation.faces[hits.faces].astype(np.int32),
        logs.astype(np.complex64),
        hits.barycentrics.astype(np.float32),
    )


_mesh: TexturedMesh | None = None  # of this process of the pool


def begin(mesh: TexturedMesh) -> None:
    """Keep the mesh for this process: it is sent once, not with every task."""
    global _mesh
    _mesh = mesh


def make_copy_here(vertices: int, samples: int, slots: int, seed: int) -> Copy:
    """`make_copy` of the mesh that `begin` was given."""
    assert _mesh is not None
    return make_copy(_mesh, vertices, samples, slots, seed)
