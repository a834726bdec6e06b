"""Smoothing a mesh without leaving the surface it stands for."""

from typing import Any

import igl
import numpy as np
from jaxtyping import Bool, Float64, Int

from flx.geometry.arrays import area_normals, dot, length_of, sum_at, unit_vectors, vertex_normals
from flx.geometry.remesh.features import CURVE, bends, features, long_curves
from flx.geometry.topology import edge_lengths, mark, topology
from flx.types import Triangulation

GAP = 0.42  # of an edge: the widest that a mesh may leave to the surface
# The same where the surface is large for its box: 0.27 % of the diagonal at 30,000 vertices.
NARROWEST = 0.435
SPACING = 0.5  # of an edge: how close the points lie that a mesh is measured at
BENT = np.cos(np.radians(30.0))  # faces that bend less meet in no edge worth measuring


class Surface:
    """The surface to stay on, for a mesh of edges of `length`: its faces, its boundary and its creases."""

    def __init__(self, vertices: Float64[Any, "V 3"], faces: Int[Any, "F 3"], length: float):
        topo = topology(faces, len(vertices))
        feature = features(vertices, faces, topo, 1)[0]
        creases = np.flatnonzero(feature & ~topo.boundary)
        lengths = edge_lengths(vertices, topo)[creases]
        creases = long_curves(topo.edges[creases], lengths, len(vertices), CURVE * length, creases)
        self.vertices, self.faces, self.length = vertices, faces, length
        self.normals = area_normals(vertices, faces)
        narrow = (
            NARROWEST * np.linalg.norm(np.ptp(vertices, axis=0)) / np.sqrt(length_of(self.normals).sum() / 2)
        )
        self.gap = min(GAP, narrow) * length
        self.normals = unit_vectors(self.normals)
        self.edges, self.face_edges = topo.edges, topo.face_edges
        self.tree = igl.AABB()
        self.tree.init(vertices, faces)
        self.boundary = np.ascontiguousarray(topo.edges[topo.boundary])
        self.creases = np.ascontiguousarray(topo.edges[creases])
        self.probes, self.outward = _probes(vertices, faces, topo, length)

    def land(
        self,
        points: Float64[Any, "N 3"],
        normals: Float64[Any, "N 3"],
        kind: Int[Any, "N"],
        rim: Bool[Any, "N"],
    ) -> tuple[Float64[Any, "N 3"], Bool[Any, "N"]]:
        """Closest points: of features on the features, of boundaries (`rim`) on the boundary, else on faces.

        Also whether they are to be trusted: on a thin wall the closest point may be the far side's, whose
        normal is another. Then it is asked for again from above and from below, where each side is apart.
        """
        landed, trusted = self._on_faces(points, normals)
        # The normal of a feature vertex says little.
        trusted |= rim | ((kind > 0) & (length_of(landed - points) < 0.5 * self.length))
        lost = np.flatnonzero(~trusted)
        apart = np.full(len(lost), self.length)
        for lift in (0.5, -0.5):
            found, faced = self._on_faces(points[lost] + lift * self.length * normals[lost], normals[lost])
            distance = length_of(found - points[lost])
            closer = faced & (distance < apart)
            apart[closer], landed[lost[closer]] = distance[closer], found[closer]
            trusted[lost[closer]] = True
        members = np.flatnonzero((kind > 0) & ~rim)
        if len(self.creases) and len(members):
            square, _, closest = igl.point_mesh_squared_distance(points[members], self.vertices, self.creases)
            near = np.asarray(square) < (0.5 * self.length) ** 2
            landed[members[near]] = np.asarray(closest)[near]
            trusted[members[near]] = True
        members = np.flatnonzero(rim)
        if len(members):
            closest = self._on_boundary(points[members], normals[members])
            near = length_of(closest - points[members]) < self.length
            landed[members[near]] = closest[near]
        return landed, trusted

    def _on_faces(self, points, normals):
        """Closest points, and whether the surface faces the same way there."""
        _, face, closest = self.tree.squared_distance(self.vertices, self.faces, np.ascontiguousarray(points))
        return np.asarray(closest), dot(self.normals[np.asarray(face)], normals) > 0.3

    def _on_boundary(self, points, normals):
        """Closest boundary points where the surface faces the same way.

        Boundary and points are lifted along their normals first: the two sides of a thin wall move apart.
        """
        lift = 0.5 * self.length
        lifted = points + lift * normals
        raised = self.vertices + lift * self.outward[: len(self.vertices)]
        _, edge, _ = igl.point_mesh_squared_distance(lifted, raised, self.boundary)
        a, b = self.boundary[np.asarray(edge)].T
        along = np.take(raised, b, 0) - np.take(raised, a, 0)
        t = dot(lifted - np.take(raised, a, 0), along) / np.maximum(dot(along, along), 1e-300)
        a, b = np.take(self.vertices, a, 0), np.take(self.vertices, b, 0)
        return a + np.clip(t, 0, 1)[:, None] * (b - a)

    def distances(self, points: Float64[Any, "N 3"]) -> Float64[Any, "N"]:
        """How far points are from the faces."""
        return np.sqrt(np.asarray(self.tree.squared_distance(self.vertices, self.faces, points)[0]))


def _probes(vertices, faces, topo, length):
    """Points that a mesh may miss, and their normals: the vertices, and others on long edges that bend."""
    normals = area_normals(vertices, faces)
    outward = vertex_normals(faces, normals, len(vertices))
    normals = unit_vectors(normals)
    pieces = np.ceil(edge_lengths(vertices, topo) / (SPACING * length)).astype(np.int64)
    bent = np.flatnonzero((pieces > 1) & ~topo.boundary & (bends(normals, topo) < BENT))
    inner = pieces[bent] - 1
    edge = np.repeat(np.arange(len(bent)), inner)
    place = 1 + np.arange(len(edge)) - (np.cumsum(inner) - inner)[edge]
    t = (place / pieces[bent[edge]])[:, None]
    a, b = topo.edges[bent[edge]].T
    return (
        np.concatenate([vertices, (1 - t) * vertices[a] + t * vertices[b]]),
        np.concatenate([outward, unit_vectors(outward[a] + outward[b])]),
    )


def smooth(
    mesh: Triangulation, surface: Surface, passes: int, pinned: Bool[Any, "V"] | None = None
) -> Triangulation:
    """Move each vertex towards the area-weighted centroid of its faces, or along its curve; project back.

    `pinned` vertices stay.
    """
    vertices, faces = mesh
    count = len(vertices)
    topo = topology(faces, count)
    edge_of_surface = mark(count, topo.edges[topo.boundary].ravel())
    for _ in range(passes):
        feature, kind = features(vertices, faces, topo)
        normals = area_normals(vertices, faces)
        area = length_of(normals)
        a, b, c = (np.take(vertices, faces[:, k], 0) for k in range(3))
        centroids = (a + b + c) * (area / 3)[:, None]
        outward = vertex_normals(faces, normals, count)
        weight = np.bincount(faces.ravel(), np.repeat(area, 3), count)
        step = sum_at(faces, centroids, count) / np.maximum(weight, 1e-300)[:, None] - vertices
        step -= dot(step, outward)[:, None] * outward
        a, b = topo.edges[feature].T
        along = sum_at(a[:, None], vertices[b], count) + sum_at(b[:, None], vertices[a], count)
        step[kind == 1] = along[kind == 1] / 2 - vertices[kind == 1]
        step[kind == 2] = 0
        if pinned is not None:
            step[pinned] = 0
        wanted = vertices + 0.6 * step
        moved, landed = surface.land(wanted, outward, kind, edge_of_surface)
        moved[~landed] = vertices[~landed]
        if pinned is not None:
            moved[pinned] = vertices[pinned]
        vertices = _without_folds(vertices, moved, faces, normals)
    return Triangulation(vertices, faces)


def _without_folds(vertices, moved, faces, normals):
    """Take back the moves that turn a face over or leave it a tenth of the mean area."""
    area = length_of(normals)
    least = np.minimum(0.1 * area.mean(), 0.9 * area)
    while True:
        folded = dot(unit_vectors(normals), area_normals(moved, faces)) < least
        back = faces[folded].ravel()
        if (moved[back] == vertices[back]).all():
            return moved
        moved[back] = vertices[back]
