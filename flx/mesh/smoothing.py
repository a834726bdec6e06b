"""Smoothing a mesh without leaving the surface it stands for."""

from typing import Any

import igl
import numpy as np
from jaxtyping import Float64, Int

from flx.mesh.features import CURVE, features, long_curves
from flx.mesh.topology import edge_lengths, mark, topology
from flx.mesh.vectors import area_normals, dot, length_of, sum_at, unit
from flx.types import Triangulation


class Surface:
    """The surface to stay on: closest points on its faces, its boundary and its creases."""

    def __init__(self, vertices: Float64[Any, "V 3"], faces: Int[Any, "F 3"], length: float):
        topo = topology(faces, len(vertices))
        feature = features(vertices, faces, topo, 1)[0]
        creases = np.flatnonzero(feature & ~topo.boundary)
        lengths = edge_lengths(vertices, topo)[creases]
        creases = long_curves(topo.edges[creases], lengths, len(vertices), CURVE * length, creases)
        self.vertices, self.faces = vertices, faces
        self.normals = unit(area_normals(vertices, faces))
        self.tree = igl.AABB()
        self.tree.init(vertices, faces)
        self.boundary = np.ascontiguousarray(topo.edges[topo.boundary])
        self.creases = np.ascontiguousarray(topo.edges[creases])

    def project(self, points, normals):
        """Closest points, and whether the surface there faces the way of `normals` (thin walls)."""
        _, face, closest = self.tree.squared_distance(self.vertices, self.faces, np.ascontiguousarray(points))
        return np.asarray(closest), dot(self.normals[np.asarray(face)], normals) > 0.3

    def project_to(self, curve, points):
        """Closest points on the segments `curve`, and their distances."""
        square, _, closest = igl.point_mesh_squared_distance(
            np.ascontiguousarray(points), self.vertices, curve
        )
        return np.asarray(closest), np.sqrt(np.asarray(square))


def smooth(mesh: Triangulation, surface: Surface, length: float, passes: int) -> Triangulation:
    """Move each vertex towards the area-weighted centroid of its faces, or along its curve; project back."""
    vertices, faces = mesh
    count = len(vertices)
    topo = topology(faces, count)
    edge_of_surface = mark(count, topo.edges[topo.boundary].ravel())
    for _ in range(passes):
        feature, kind = features(vertices, faces, topo)
        normals = area_normals(vertices, faces)
        area = length_of(normals)
        centroids = vertices[faces].mean(1) * area[:, None]
        vertex_normals = unit(sum_at(faces, normals, count))
        weight = np.bincount(faces.ravel(), np.repeat(area, 3), count)
        step = sum_at(faces, centroids, count) / np.maximum(weight, 1e-300)[:, None] - vertices
        step -= dot(step, vertex_normals)[:, None] * vertex_normals
        a, b = topo.edges[feature].T
        along = sum_at(a[:, None], vertices[b], count) + sum_at(b[:, None], vertices[a], count)
        step[kind == 1] = along[kind == 1] / 2 - vertices[kind == 1]
        step[kind == 2] = 0
        wanted = vertices + 0.6 * step
        moved, facing = surface.project(wanted, vertex_normals)
        # The normal of a feature vertex says little.
        facing |= edge_of_surface | ((kind > 0) & (length_of(moved - wanted) < 0.5 * length))
        for curve, members, reach in (
            (surface.creases, np.flatnonzero((kind > 0) & ~edge_of_surface), 0.5 * length),
            (surface.boundary, np.flatnonzero(edge_of_surface), length),
        ):
            if len(curve) and len(members):
                closest, distance = surface.project_to(curve, wanted[members])
                near = distance < reach
                moved[members[near]] = closest[near]
                facing[members[near]] = True
        moved[~facing] = vertices[~facing]
        vertices = _without_folds(vertices, moved, faces, normals)
    return Triangulation(vertices, faces)


def _without_folds(vertices, moved, faces, normals):
    """Take back the moves that turn a face over or leave it a tenth of the mean area."""
    area = length_of(normals)
    least = np.minimum(0.1 * area.mean(), 0.9 * area)
    while True:
        folded = dot(unit(normals), area_normals(moved, faces)) < least
        back = faces[folded].ravel()
        if (moved[back] == vertices[back]).all():
            return moved
        moved[back] = vertices[back]
