"""Tangential smoothing, with projection back onto the surface that the mesh approximates."""

from typing import Any

import igl
import numpy as np
from jaxtyping import Bool, Float64, Int

from flx.geometry.arrays import Vectors, area_normals, dot, length_of, sum_at, unit_vectors, vertex_normals
from flx.geometry.remesh.features import CURVE, bends, features, long_curves
from flx.geometry.topology import edge_lengths, topology
from flx.types import Faces, Triangulation, Vertices

GAP = 0.42  # widest gap allowed between mesh and surface, in wanted edge lengths
# Upper bound of that limit, in units of diagonal / √area: 0.27 % of the diagonal at 30,000 vertices. It
# applies if the surface is large for its bounding box.
NARROWEST = 0.435
SPACING = 0.5  # spacing of the probes on long edges, in wanted edge lengths
BENT_COSINE = np.cos(np.radians(30.0))  # edges between faces that bend by less than 30° get no probes


class ReferenceSurface:
    """The surface that a mesh with edges of `length` must stay on: its faces, boundary and creases.

    `gap` is the widest distance allowed between the two; `probes` are points that the mesh must not miss,
    with the normals `outward`.
    """

    def __init__(self, vertices: Vertices, faces: Faces, length: float):
        topo = topology(faces, len(vertices))
        feature = features(vertices, faces, topo, 1)[0]
        creases = np.flatnonzero(feature & ~topo.boundary)
        lengths = edge_lengths(vertices, topo)[creases]
        creases = long_curves(topo.edges[creases], lengths, len(vertices), CURVE * length, creases)
        self.vertices, self.faces, self.length = vertices, faces, length
        normals = area_normals(vertices, faces)
        diagonal, area = np.linalg.norm(np.ptp(vertices, axis=0)), length_of(normals).sum() / 2
        self.gap = min(GAP, NARROWEST * diagonal / np.sqrt(area)) * length
        self.normals = unit_vectors(normals)
        self.edges, self.face_edges = topo.edges, topo.face_edges
        self.tree = igl.AABB()
        self.tree.init(vertices, faces)
        self.boundary = np.ascontiguousarray(topo.edges[topo.boundary])
        self.creases = np.ascontiguousarray(topo.edges[creases])
        outward = vertex_normals(faces, normals, len(vertices))
        self.probes, self.outward = _probes(vertices, topo, self.normals, outward, length)

    def project(
        self, points: Vectors, normals: Vectors, kind: Int[Any, "N"], rim: Bool[Any, "N"]
    ) -> tuple[Vectors, Bool[Any, "N"]]:
        """The closest points on the boundary (for `rim`), on creases (for `kind` > 0), otherwise on faces.

        Returns them and whether they lie on the point's own side. On a thin wall the closest point may be on
        the far side, where the normal differs; the search is then repeated from above and below the point,
        where the two sides are farther apart.
        """
        landed, on_own_side = self._on_faces(points, normals)
        # The normal of a feature vertex is unreliable, so a close point is accepted without comparing it.
        on_own_side |= rim | ((kind > 0) & (length_of(landed - points) < 0.5 * self.length))
        opposed = np.flatnonzero(~on_own_side)
        apart = np.full(len(opposed), self.length)
        for lift in (0.5, -0.5):
            starts = points[opposed] + lift * self.length * normals[opposed]
            candidates, agrees = self._on_faces(starts, normals[opposed])
            distance = length_of(candidates - points[opposed])
            closer = agrees & (distance < apart)
            apart[closer], landed[opposed[closer]] = distance[closer], candidates[closer]
            on_own_side[opposed[closer]] = True
        members = np.flatnonzero((kind > 0) & ~rim)
        if len(self.creases) and len(members):
            square, _, closest = igl.point_mesh_squared_distance(points[members], self.vertices, self.creases)
            near = np.asarray(square) < (0.5 * self.length) ** 2
            landed[members[near]] = np.asarray(closest)[near]
            on_own_side[members[near]] = True
        members = np.flatnonzero(rim)
        if len(members):
            closest = self._on_boundary(points[members], normals[members])
            near = length_of(closest - points[members]) < self.length
            landed[members[near]] = closest[near]
        return landed, on_own_side

    def _on_faces(self, points, normals):
        """The closest points on faces, and whether the surface faces the same way there."""
        _, face, closest = self.tree.squared_distance(self.vertices, self.faces, np.ascontiguousarray(points))
        return np.asarray(closest), dot(self.normals[np.asarray(face)], normals) > 0.3

    def _on_boundary(self, points, normals):
        """The closest boundary points where the surface faces the same way.

        Boundary and points are first lifted along their normals, which separates the sides of a thin wall.
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
        """The distance of each point from the surface."""
        return np.sqrt(np.asarray(self.tree.squared_distance(self.vertices, self.faces, points)[0]))


def _probes(vertices, topo, normals, outward, length):
    """Points that a mesh might miss, and their normals: all vertices, and points on long, bent edges."""
    pieces = np.ceil(edge_lengths(vertices, topo) / (SPACING * length)).astype(np.int64)
    bent = np.flatnonzero((pieces > 1) & ~topo.boundary & (bends(normals, topo) < BENT_COSINE))
    inner = pieces[bent] - 1
    edge = np.repeat(np.arange(len(bent)), inner)
    place = 1 + np.arange(len(edge)) - (np.cumsum(inner) - inner)[edge]
    t = (place / pieces[bent[edge]])[:, None]
    a, b = topo.edges[bent[edge]].T
    points = np.concatenate([vertices, (1 - t) * vertices[a] + t * vertices[b]])
    return points, np.concatenate([outward, unit_vectors(outward[a] + outward[b])])


def smooth(
    mesh: Triangulation, surface: ReferenceSurface, passes: int, pinned: Bool[Any, "V"] | None = None
) -> Triangulation:
    """Move each vertex towards the area-weighted centroid of its faces, then project it onto the surface.

    Vertices of feature curves move along their curve; corners and `pinned` vertices stay. Moves that would
    fold a face, or end on the wrong side of a thin wall, are undone.
    """
    vertices, faces = mesh
    count = len(vertices)
    topo = topology(faces, count)
    rim = topo.rim
    pinned = np.zeros(count, bool) if pinned is None else pinned
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
        step[pinned | (kind == 2)] = 0
        moved, on_own_side = surface.project(vertices + 0.6 * step, outward, kind, rim)
        stays = pinned | ~on_own_side
        moved[stays] = vertices[stays]
        vertices = _without_folds(vertices, moved, faces, normals)
    return Triangulation(vertices, faces)


def _without_folds(vertices, moved, faces, normals):
    """Undo the moves that turn a face over or shrink it below a tenth of the mean area."""
    area = length_of(normals)
    least = np.minimum(0.1 * area.mean(), 0.9 * area)
    while True:
        folded = dot(unit_vectors(normals), area_normals(moved, faces)) < least
        back = faces[folded].ravel()
        if (moved[back] == vertices[back]).all():
            return moved
        moved[back] = vertices[back]
