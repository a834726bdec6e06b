"""What libigl and trimesh say of a mesh: flx is held against it."""

import igl
import numpy as np
import trimesh
from scipy.spatial import KDTree

from flx.geometry.topology import edge_lengths, topology
from flx.types import Triangulation


def boundary_loops(faces):
    return len(igl.boundary_loop_all(faces))


def components(faces):
    return igl.facet_components(faces)[0]


def min_angles(mesh):
    return np.degrees(igl.internal_angles(mesh.vertices, mesh.faces).min(1))


def points_on(mesh, count=20_000):
    points, _ = trimesh.sample.sample_surface(trimesh.Trimesh(*mesh, process=False), count, seed=0)
    return np.concatenate([np.asarray(points), mesh.vertices])


def distances(points, mesh):
    return np.sqrt(igl.point_mesh_squared_distance(np.ascontiguousarray(points), *mesh)[0])


def edge_length(mesh):
    return np.sqrt(igl.doublearea(*mesh).sum() / np.sqrt(3) / len(mesh.vertices))


def assert_sound(mesh):
    """Every directed edge once (manifold and oriented), every vertex one fan."""
    half_edges = np.concatenate([mesh.faces[:, [i, (i + 1) % 3]] for i in range(3)])
    assert len(np.unique(half_edges, axis=0)) == len(half_edges)
    assert igl.is_edge_manifold(mesh.faces)[0] and np.all(igl.is_vertex_manifold(mesh.faces))
    assert len(np.unique(mesh.faces)) == len(mesh.vertices)
    assert igl.doublearea(*mesh).min() > 0


def mean_edge(mesh: Triangulation) -> float:
    return float(edge_lengths(mesh.vertices, topology(mesh.faces, len(mesh.vertices))).mean())


def pairs_of(mesh: Triangulation) -> np.ndarray:
    return topology(mesh.faces, len(mesh.vertices)).edges


def coincidence(a: Triangulation, b: Triangulation) -> float:
    """Share of the vertices of b within 0.1 mean edge lengths of b of a vertex of a; 0.036 by chance."""
    return float((KDTree(a.vertices).query(b.vertices)[0] < 0.1 * mean_edge(b)).mean())
