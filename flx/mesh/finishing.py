"""The last touch of a remeshed copy: vertices moved to widen the sharpest angles and close the widest gaps.

Smoothing cares for the mean; here a vertex moves where its worst face or its worst gap gets better, and
otherwise stays. Few vertices are asked, so it costs little.
"""

from typing import Any

import igl
import numpy as np
from jaxtyping import Bool
from scipy.spatial import KDTree

from flx.mesh.features import features
from flx.mesh.operators import ranks
from flx.mesh.smoothing import Surface
from flx.mesh.topology import mark, topology
from flx.mesh.vectors import area_normals, dot, length_of, sum_at, unit
from flx.types import Triangulation

SHARP = np.cos(np.radians(38.0))  # corners below 38° are asked to widen
TRIES = 16  # of each vertex asked
GAP = 0.35  # of an edge: wider gaps are closed
ROUNDS = 5
FAIR = np.cos(np.radians(35.0))  # the sharpest corner that closing a gap makes
NARROW = np.cos(np.radians(20.0))  # the sharpest that closing the widest gaps makes
SHARE = 0.006  # of all faces: as many may be sharper than that


def finish(mesh: Triangulation, surface: Surface, rng: np.random.Generator) -> Triangulation:
    """Widen angles, close gaps, and widen what that sharpened."""
    mesh = _widen_angles(mesh, np.zeros(len(mesh.vertices), bool), surface, rng)
    return _widen_angles(*_close_gaps(mesh, surface, rng), surface, rng)


def _widen_angles(
    mesh: Triangulation, pinned: Bool[Any, "V"], surface: Surface, rng: np.random.Generator
) -> Triangulation:
    """Move vertices of sharp faces at random, on the surface, and keep what widens their sharpest corner.

    Features slide along themselves and corners stay, but for needles; `pinned` vertices stay.
    """
    vertices, faces = mesh[0].copy(), mesh[1]
    count = len(vertices)
    topo = topology(faces, count)
    kind = features(vertices, faces, topo)[1]
    rim = mark(count, topo.edges[topo.boundary].ravel())
    cosines = _sharpest_cosines(vertices, faces)
    for _ in range(TRIES):
        needles = mark(count, faces[cosines > NARROW].ravel())
        asked = np.unique(faces[cosines > SHARP])
        asked = asked[((kind[asked] < 2) | needles[asked]) & ~pinned[asked]]
        asked = asked[_independent(topo.edges, count, asked, rng.permutation(len(asked)))]
        stars = _Stars(vertices, faces, count, asked)
        step = rng.normal(size=(len(asked), 3)) * (0.2 * surface.length * rng.random(len(asked)))[:, None]
        step -= dot(step, stars.normals)[:, None] * stars.normals
        landed, trusted = surface.land(vertices[asked] + step, stars.normals, kind[asked], rim[asked])
        moved = vertices.copy()
        moved[asked] = landed
        after = _sharpest_cosines(moved, stars.faces)
        better = trusted & stars.keep_facing(moved) & (stars.worst(after) < stars.worst(cosines[stars.ids]))
        vertices[asked[better]] = landed[better]
        kept = better[stars.owners]
        cosines[stars.ids[kept]] = after[kept]
    return Triangulation(vertices, faces)


def _close_gaps(
    mesh: Triangulation, surface: Surface, rng: np.random.Generator
) -> tuple[Triangulation, Bool[Any, "V"]]:
    """Move vertices onto points of the surface that the mesh misses by far, and keep what closes the gap.

    Smoothing slides off the tips of spikes and off fillets narrower than an edge. The surface's own vertices
    are asked: its farthest points, where it is finer than the mesh or bends sharply. A vertex goes only
    where the surface faces its way. Also returns which vertices moved.
    """
    vertices, faces = mesh[0].copy(), mesh[1]
    count, least = len(vertices), GAP * surface.length
    missed = np.flatnonzero(_gaps(surface.vertices, vertices, faces)[0] > least)
    pinned = np.zeros(count, bool)
    targets, outward = surface.vertices[missed], surface.vertex_normals()[missed]
    topo = topology(faces, count)
    rim = mark(count, topo.edges[topo.boundary].ravel())
    for _ in range(ROUNDS if len(targets) else 0):
        local = faces[_around(targets, vertices, faces, 3 * surface.length)]
        gaps, hit = _gaps(targets, vertices, local)
        movers, facing = _nearest_corners(targets, outward, vertices, local[hit])
        open_ = np.flatnonzero((gaps > least) & facing & ~rim[movers])
        open_ = open_[np.argsort(-gaps[open_], kind="stable")]
        asked, widest = np.unique(movers[open_], return_index=True)
        chosen = _independent(topo.edges, count, asked, rng.permutation(len(asked)))
        asked, goals = asked[chosen], open_[widest[chosen]]
        if not len(asked):
            break
        stars = _Stars(vertices, faces, count, asked)
        moved = vertices.copy()
        moved[asked] = targets[goals]
        sharpest = stars.worst(_sharpest_cosines(moved, stars.faces))
        sharp = int((_sharpest_cosines(vertices, faces) > FAIR).sum())
        room = (SHARE * len(faces) - sharp) / 4  # a star moved has so many sharp faces
        limit = np.where(ranks(-gaps[goals]) < room, NARROW, FAIR)
        better = sharpest < np.maximum(stars.worst(_sharpest_cosines(vertices, stars.faces)), limit)
        better &= stars.keep_facing(moved, 0.1)
        # Of the targets that lie over a star, the widest gap must become narrower.
        over = stars.owner[movers] >= 0
        before, after = np.zeros((2, len(asked)))
        np.maximum.at(before, stars.owner[movers[over]], gaps[over])
        np.maximum.at(after, stars.owner[movers[over]], _gaps(targets[over], moved, local)[0])
        better &= after < before
        vertices[asked[better]] = moved[asked[better]]
        pinned[asked[better]] = True
    return Triangulation(vertices, faces), pinned


def _gaps(targets, vertices, faces):
    """How far targets are from a mesh, and which face is the closest."""
    square, face, _ = igl.point_mesh_squared_distance(targets, vertices, faces)
    return np.sqrt(np.asarray(square)), np.asarray(face)


def _around(targets, vertices, faces, reach):
    """Which faces have a corner within `reach` of a target."""
    near = np.isfinite(KDTree(targets).query(vertices, distance_upper_bound=reach)[0])
    return near[faces].any(1)


def _nearest_corners(targets, outward, vertices, faces):
    """The corner of each target's face that is nearest, and whether the face looks the target's way."""
    apart = np.stack([length_of(vertices[faces[:, k]] - targets) for k in range(3)], 1)
    nearest = np.take_along_axis(faces, apart.argmin(1)[:, None], 1)[:, 0]
    return nearest, dot(area_normals(vertices, faces), outward) > 0


class _Stars:
    """The faces around each of some vertices, no two of them adjacent."""

    def __init__(self, vertices, faces, count, centers):
        self.owner = np.full(count, -1)  # the star of each of the mesh's vertices that is the centre of one
        self.owner[centers] = np.arange(len(centers))
        owners = np.maximum.reduce([np.take(self.owner, faces[:, k]) for k in range(3)])
        self.ids = np.flatnonzero(owners >= 0)
        self.faces, self.owners, self.size = faces[self.ids], owners[self.ids], len(centers)
        self.face_normals = area_normals(vertices, self.faces)
        self.normals = unit(sum_at(self.owners[:, None], self.face_normals, self.size))

    def worst(self, values):
        """The largest of the values of each star's faces."""
        worst = np.full(self.size, -np.inf)
        np.maximum.at(worst, self.owners, values)
        return worst

    def keep_facing(self, moved, least=0.5):
        """Whether no face of the star turns by more than arccos(`least`)."""
        turn = dot(unit(self.face_normals), unit(area_normals(moved, self.faces)))
        return self.worst(-turn) < -least


def _independent(edges, count, asked, rank):
    """Which of the vertices asked have a lower rank than all their neighbours."""
    place = np.full(count, len(asked))
    place[asked] = rank
    later = np.maximum(*np.take(place, edges.T))
    return ~mark(len(asked) + 1, later)[rank]


def _sharpest_cosines(vertices, faces):
    """The cosine of each face's smallest angle."""
    a, b, c = (np.take(vertices, faces[:, k], 0) for k in range(3))
    sides = np.sort([dot(u, u) for u in (b - a, c - b, a - c)], axis=0)
    return (sides[1] + sides[2] - sides[0]) / (2 * np.sqrt(sides[1] * sides[2]) + 1e-300)
