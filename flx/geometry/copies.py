"""Triangulated copies of a textured mesh, and how points of the mesh look from a copy's vertices."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Complex64

from flx.geometry.arrays import Rng, chunks
from flx.geometry.raster import CHUNK
from flx.geometry.remesh.remesh import remesh
from flx.geometry.sampling import ring_points, surface_colors, transfer
from flx.geometry.tables import mesh_tables
from flx.geometry.tangent import TangentFrames, corner_logs, tangent_frames
from flx.machine import memory
from flx.types import MeshTables, Queries, RingSamples, SurfacePoints, TexturedMesh, Triangulation

COPY_BYTES = 600  # per vertex of a prepared copy: tables and codes, on disk and in memory
# Of a process that makes a copy: measured on meshes of 9,320 to 66,122 faces at 1,000 to 20,000 vertices.
BASE_BYTES, VERTEX_BYTES, FACE_BYTES = 1e8, 15_000, 1_000


def memory_to_make(vertices: int, mesh: TexturedMesh) -> float:
    """An estimate of the bytes that a process holds while it makes a copy."""
    images = sum(image.nbytes for image in mesh.textures)
    return BASE_BYTES + VERTEX_BYTES * vertices + FACE_BYTES * len(mesh.faces) + images


def check_memory(vertices: int, copies: int = 1) -> None:
    """Raises ValueError where so many vertices or copies cannot fit into this machine's memory."""
    total = machine.total if (machine := memory()) else float("inf")
    one, all_of_them = BASE_BYTES + VERTEX_BYTES * vertices, COPY_BYTES * vertices * copies
    if one > total:
        raise ValueError(
            f"a copy of {vertices:,} vertices takes about {one / 1e9:,.0f} GB of memory "
            f"while it is made, and this machine has {total / 1e9:,.0f} GB; give at most "
            f"{max(0, (total - BASE_BYTES) / VERTEX_BYTES):,.0f} vertices"
        )
    if all_of_them > total:
        raise ValueError(
            f"{copies:,} copies of {vertices:,} vertices take about {all_of_them / 1e9:,.0f} GB of memory, "
            f"and this machine has {total / 1e9:,.0f} GB; give at most "
            f"{total / (COPY_BYTES * vertices):,.0f} copies"
        )


class Copy(NamedTuple):
    """One triangulation of the surface, its gather tables, and colours sampled in its one-rings."""

    triangulation: Triangulation
    tables: MeshTables
    rings: RingSamples


def make_copy(mesh: TexturedMesh, vertices: int, samples: int, slots: int, seed: int) -> Copy:
    """Remesh to `vertices`, build the tables and sample `samples` colours in every one-ring.

    The same seed gives the same bits. Raises ValueError if the mesh cannot be remeshed to so few vertices, or
    a ring needs more than `slots` slots.
    """
    return copy_on(mesh, remesh(mesh.vertices, mesh.faces, vertices, seed), samples, slots, seed)


def copy_on(mesh: TexturedMesh, triangulation: Triangulation, samples: int, slots: int, seed: int) -> Copy:
    """The tables of a triangulation of the mesh's surface, and `samples` colours in each of its one-rings."""
    tables = mesh_tables(triangulation, slots=slots, seed=seed)
    return Copy(triangulation, tables, sample_rings(mesh, triangulation, samples, seed))


def sample_rings(mesh: TexturedMesh, triangulation: Triangulation, samples: int, seed: int) -> RingSamples:
    """Colours of `mesh` at points uniform by area in each one-ring of the copy."""
    points, logs = points_in_rings(triangulation, samples, np.random.default_rng(seed))
    hits = transfer(points, triangulation, mesh)
    return RingSamples(logs, surface_colors(mesh, hits).reshape(*logs.shape, 3))


def points_in_rings(
    triangulation: Triangulation, samples: int, rng: Rng
) -> tuple[SurfacePoints, Complex64[Any, "V S"]]:
    """Points uniform by area in each one-ring, from v·samples on for vertex v, and their logs at v."""
    points, corners = ring_points(triangulation, samples, rng)
    frames, logs = tangent_frames(triangulation), np.empty(corners.size, np.complex64)
    for part in chunks(len(logs), CHUNK):  # the logs of all corners would be most of a worker's memory
        seen = corner_logs(frames, triangulation, points.faces[part], points.barycentrics[part])
        logs[part] = np.take_along_axis(seen, corners.reshape(-1, 1)[part], axis=1)[:, 0]
    return points, logs.reshape(corners.shape)


def queries_at(hits: SurfacePoints, triangulation: Triangulation, frames: TangentFrames) -> Queries:
    """What the decoder needs for points of the copy: each seen from the corners of its face."""
    corners = triangulation.faces[hits.faces].astype(np.int32)
    logs = corner_logs(frames, triangulation, hits.faces, hits.barycentrics).astype(np.complex64)
    return Queries(corners, logs, hits.barycentrics.astype(np.float32))
