"""Keeping a remeshed copy close to its surface, both ways: no tip is cut off, no crease is cut across.

Smoothing slides off the tips of spikes and off fillets narrower than an edge, and edges run across creases
that bend too little or are too short to be features. First vertices go to the farthest points of the surface
(`reach`) while the copy can still be smoothed around them; what is left is searched at random (`tighten`).
"""

from typing import Any

import igl
import numpy as np
from jaxtyping import Bool, Int

from flx.mesh.features import features
from flx.mesh.operators import disjoint, ranks
from flx.mesh.smoothing import Surface
from flx.mesh.stars import Stars, independent, largest, sharpest_cosines
from flx.mesh.topology import has_edge, mark, topology
from flx.mesh.vectors import area_normals, dot, length_of, sum_at, unit
from flx.types import Triangulation

EASY = 0.7  # of the gap allowed: narrower ones are nothing to the search for a better place
TRIES = 80  # of each place
SHARP_TRIES = 8  # of faces that are sharp but close to the surface
STEP = 0.6  # of an edge: the longest random move, nearly
AIMED = 0.5  # share of the moves that go towards a point that the mesh misses, where there is one
COARSE = 3e-3  # of the diagonal: a mesh that may leave wider gaps closes none but its widest,
WIDEST = 3e-3  # this share of them: all of a surface finer than the mesh would cost it its angles
UPRIGHT = 0.1  # the least cosine between a face and its patch
FAIR = np.cos(np.radians(35.0))  # the sharpest corner that the search makes
NEEDLE = np.cos(np.radians(10.0))  # the sharpest that reaching a tip makes, before it is smoothed
SLOPE = np.cos(np.radians(25.0))  # faces that lean less against their corners' normals hide no gap
# Barycentric coordinates that are multiples of a third: corners too, since not all have landed.
LATTICE = np.array([(i, j, 3 - i - j) for i in range(4) for j in range(4 - i)]) / 3


def gap_to_close(mesh: Triangulation, surface: Surface) -> float:
    """From which width on gaps are worth closing."""
    if surface.gap < COARSE * np.linalg.norm(np.ptp(surface.vertices, axis=0)):
        return surface.gap
    return max(surface.gap, float(np.quantile(_gaps(surface.probes, *mesh)[0], 1 - WIDEST)))


def reach(
    mesh: Triangulation, surface: Surface, pinned: Bool[Any, "V"], probes: Int[Any, "N"]
) -> tuple[Triangulation, Bool[Any, "V"], Int[Any, "n"]]:
    """Move vertices onto the points of the surface that the mesh misses by far, and pin them there.

    Of two neighbours the one with the wider gap goes; pinned and boundary vertices stay, and a vertex goes
    only where the surface faces its way. `probes` are the points asked. Returns the mesh, which vertices are
    pinned now, and which probes to ask again, when the mesh has been smoothed.
    """
    vertices, faces = mesh[0].copy(), mesh[1]
    count = len(vertices)
    gaps, hit = _gaps(surface.probes[probes], vertices, faces)
    again = probes[gaps > surface.gap / 2]
    missed = np.flatnonzero(gaps > surface.gap)
    targets, outward = surface.probes[probes[missed]], surface.outward[probes[missed]]
    gaps = gaps[missed]
    topo = topology(faces, count)
    rim = mark(count, topo.edges[topo.boundary].ravel())
    near = faces[hit[missed]]
    apart = np.stack([length_of(vertices[near[:, k]] - targets) for k in range(3)], 1)
    movers = np.take_along_axis(near, apart.argmin(1)[:, None], 1)[:, 0]
    open_ = ~rim[movers] & ~pinned[movers] & (dot(area_normals(vertices, near), outward) > 0)
    widest = np.flatnonzero(open_)[np.argsort(-gaps[open_], kind="stable")]
    asked, first = np.unique(movers[widest], return_index=True)
    goals = widest[first]
    chosen = independent(topo.edges, count, asked, ranks(-gaps[goals]))
    asked, goals = asked[chosen], goals[chosen]
    stars = Stars(vertices, faces, asked)
    moved = vertices.copy()
    moved[asked] = targets[goals]
    good = stars.keep_facing(moved, 0.1) & (stars.worst(sharpest_cosines(moved, stars.faces)) < NEEDLE)
    vertices[asked[good]] = moved[asked[good]]
    return Triangulation(vertices, faces), pinned | mark(count, asked[good]), again


def tighten(mesh: Triangulation, surface: Surface, rng: np.random.Generator) -> Triangulation:
    """Move vertices and flip edges at random where the mesh is far from the surface, the surface from it, or
    a corner sharp, and keep what makes the sum of squared excesses smaller.

    Only faces around such places are asked, so it costs little.
    """
    vertices, faces = mesh[0].copy(), mesh[1].copy()
    gaps, hits = _gaps(surface.probes, vertices, faces)
    gaps /= surface.gap
    leaning = _leaning(vertices, faces)
    sags = np.zeros((len(faces), len(LATTICE)))
    sags[leaning] = _sags(surface, vertices, faces[leaning])
    cosines = sharpest_cosines(vertices, faces)
    far = sags.max(1) > 1
    for attempt in range(TRIES):
        wide = far.copy()
        wide[hits[gaps > 1]] = True
        bad = wide | (cosines > FAIR) & (attempt < SHARP_TRIES)
        if not bad.any():
            break
        loose = _grown(wide, faces, len(vertices))
        # A part of the mesh, two rings around the faces asked, with vertices of its own.
        part = np.flatnonzero(_grown(_grown(bad, faces, len(vertices)), faces, len(vertices)))
        inside, local = np.unique(faces[part], return_inverse=True)
        local = local.reshape(-1, 3)
        points, asked = vertices[inside], np.flatnonzero(bad[part])
        if attempt % 2:
            moved, rows, turned, owners, size = _flips(points, local, asked, loose[part], rng)
        else:
            missed = np.flatnonzero(gaps > 1)
            place = np.full(len(faces), -1)
            place[part] = np.arange(len(part))
            goals = np.full((len(local), 3), np.nan)
            goals[place[hits[missed]]] = surface.probes[missed]
            moved, rows, turned, owners, size = _moves(
                points, local, asked, loose[part], goals[asked], surface, rng
            )
        if not size:
            continue
        patch = np.full(len(faces), -1)
        patch[part[rows]] = owners
        asked = np.flatnonzero(patch[hits] >= 0)
        after = local.copy()
        after[rows] = turned
        new_gaps, new_hits = _gaps(surface.probes[asked], moved, after)
        new_gaps /= surface.gap
        new_sags = _sags(surface, moved, turned)
        new_cosines = sharpest_cosines(moved, turned)
        by_probe = patch[hits[asked]]
        before = _cost(owners, size, sags[part[rows]], cosines[part[rows]], by_probe, gaps[asked])
        better = _cost(owners, size, new_sags, new_cosines, by_probe, new_gaps) < before
        better &= _upright(vertices[inside], local[rows], moved, turned, owners, size)
        kept = better[owners]
        rows, turned = part[rows[kept]], turned[kept]
        vertices[inside[turned]] = moved[turned]
        faces[rows] = inside[turned]
        sags[rows], cosines[rows] = new_sags[kept], new_cosines[kept]
        far[rows] = new_sags[kept].max(1) > 1
        kept = better[by_probe]
        gaps[asked[kept]], hits[asked[kept]] = new_gaps[kept], part[new_hits[kept]]
    return Triangulation(vertices, faces)


def _cost(owners, size, sags, cosines, by_probe, gaps):
    """Of each patch: squares of gaps beyond `EASY` and of cosines beyond `FAIR`, summed."""
    faces = (np.maximum(sags - EASY, 0) ** 2).sum(1) + np.maximum(cosines - FAIR, 0) ** 2
    return np.bincount(owners, faces, size) + np.bincount(by_probe, np.maximum(gaps - EASY, 0) ** 2, size)


def _grown(faces_in, faces, count):
    """With all faces that share a vertex."""
    return mark(count, faces[faces_in].ravel())[faces].any(1)


def _moves(vertices, faces, bad, loose, goals, surface, rng):
    """Stars of corners of bad faces, no two adjacent, their centres moved at random on the surface."""
    count = len(vertices)
    topo = topology(faces, count)
    kind = features(vertices, faces, topo)[1]
    rim = mark(count, topo.edges[topo.boundary].ravel())
    corners = faces[bad, rng.integers(3, size=len(bad))]
    asked, first = np.unique(corners, return_index=True)
    goals = goals[first]
    free = ~rim[asked] & ((kind[asked] < 2) | loose[bad[first]])
    asked, goals = asked[free], goals[free]
    won = independent(topo.edges, count, asked, rng.permutation(len(asked)))
    asked, goals = asked[won], goals[won]
    stars = Stars(vertices, faces, asked)
    step = rng.normal(size=(len(asked), 3)) * (STEP * surface.length * rng.random(len(asked)))[:, None]
    step -= dot(step, stars.normals)[:, None] * stars.normals
    aimed = np.isfinite(goals[:, 0]) & (rng.random(len(asked)) < AIMED)
    share = rng.uniform(0.5, 1.5, (len(asked), 1))
    step[aimed] = (share * (goals - vertices[asked]))[aimed]
    landed, trusted = surface.land(vertices[asked] + step, stars.normals, kind[asked], rim[asked])
    # What never landed has no side to keep to.
    trusted |= surface.distances(vertices[asked]) > 0.1 * surface.length
    there = aimed & (share[:, 0] > 1)
    landed[there], trusted[there] = goals[there], True
    moved = vertices.copy()
    moved[asked[trusted]] = landed[trusted]
    return moved, stars.ids, stars.faces, stars.owners, len(asked)


def _flips(vertices, faces, bad, loose, rng):
    """Pairs of faces, one of each bad, no two of them touching, with their common edge flipped."""
    count = len(vertices)
    topo = topology(faces, count)
    edges = np.unique(topo.face_edges[bad, rng.integers(3, size=len(bad))])
    free = ~features(vertices, faces, topo)[0] | mark(len(topo.edges), topo.face_edges[loose])
    edges = edges[free[edges] & ~topo.boundary[edges]]
    rows, corner = topo.corners[edges] // 3, topo.corners[edges, 0] % 3
    p, q = faces.ravel()[topo.corners[edges].T]
    a, b = faces[rows[:, 0], (corner + 1) % 3], faces[rows[:, 0], (corner + 2) % 3]
    valence = np.bincount(topo.edges.ravel(), minlength=count)
    rim = mark(count, topo.edges[topo.boundary].ravel())  # beyond it p and q may be joined
    good = (valence[a] > 3) & (valence[b] > 3) & ~(rim[p] & rim[q]) & ~has_edge(topo, count, p, q)
    quads, rows = np.stack([a, b, p, q], 1)[good], rows[good]
    chosen = disjoint(quads, count, rng.random(len(quads)))
    quads, rows = quads[chosen], rows[chosen]
    turned = np.concatenate([quads[:, [2, 0, 3]], quads[:, [3, 1, 2]]])
    return vertices, rows.T.ravel(), turned, np.tile(np.arange(len(quads)), 2), len(quads)


def _upright(vertices, faces, moved, turned, owners, size):
    """Whether the faces of a patch look one way, or about as well as before, and none is a needle."""
    before, after = area_normals(vertices, faces), area_normals(moved, turned)
    mean = [unit(sum_at(owners[:, None], normals, size)) for normals in (before, after)]
    down = [
        largest(owners, -dot(unit(normals), mean[k][owners]), size)
        for k, normals in ((0, before), (1, after))
    ]
    sharp = [
        largest(owners, sharpest_cosines(*these), size) for these in ((vertices, faces), (moved, turned))
    ]
    good = (down[1] < np.maximum(down[0], -UPRIGHT)) & (dot(*mean) > 0.3)
    return good & (sharp[1] < np.maximum(sharp[0], NEEDLE))


def _leaning(vertices, faces):
    """Which faces lean against the normal of a corner; the others hide no gap."""
    normals = area_normals(vertices, faces)
    corners = unit(sum_at(faces, normals, len(vertices)))
    normals = unit(normals)
    return np.minimum.reduce([dot(normals, np.take(corners, faces[:, k], 0)) for k in range(3)]) < SLOPE


def _sags(surface, vertices, faces):
    """How far the points `LATTICE` of faces are from the surface, in gaps allowed."""
    points = np.einsum("pk,fkc->fpc", LATTICE, np.take(vertices, faces, 0))
    return surface.distances(points.reshape(-1, 3)).reshape(len(faces), len(LATTICE)) / surface.gap


def _gaps(points, vertices, faces):
    """How far points are from a mesh, and which face is the closest."""
    square, face, _ = igl.point_mesh_squared_distance(points, vertices, faces)
    return np.sqrt(np.asarray(square)), np.asarray(face)
