"""Keeping a remeshed copy close to its surface, both ways: no tip is cut off, no crease is cut across.

Smoothing slides off the tips of spikes and off fillets narrower than an edge, and edges run across creases
that bend too little or are too short to be features. First vertices go to the farthest points of the surface
(`reach`) while the copy can still be smoothed around them; what is left is searched at random (`tighten`).
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int

from flx.geometry.arrays import area_normals, dot, length_of, sum_at, unit_vectors
from flx.geometry.remesh.deviation import EASY, fit_of, gaps_of, shapes_of
from flx.geometry.remesh.operators import disjoint, ranks
from flx.geometry.remesh.smoothing import Surface
from flx.geometry.remesh.stars import Stars, independent, largest, longest_sides, sharpest_cosines
from flx.geometry.topology import all_of, any_of, has_edge, mark, topology
from flx.types import Triangulation

LAPS, TRIES = 30, 8  # of each place
SHARP_LAPS = 2  # in which places that are only sharp are looked at, too, or while there are not few:
FEW_SHARP = 0.007  # of the faces
RINGS = 3  # of faces around the places of a lap
STEP = 0.6  # of an edge: the longest random move, nearly
ANEW = 0.3  # share of the moves that start amid a vertex's neighbours and end anywhere
AIMED = 0.5  # share of the moves that go towards a point that the mesh misses, where there is one
COARSE = 3e-3  # of the diagonal: a mesh that may leave wider gaps closes none but its widest,
WIDEST = 3e-3  # this share of them: all of a surface finer than the mesh would cost it its angles
LONGEST = 1.7  # edges, in wanted lengths, that the search makes
UPRIGHT = 0.1  # the least cosine between a face and its patch
FAIR = np.cos(np.radians(35.0))  # the sharpest corner that the search makes
NEEDLE = np.cos(np.radians(10.0))  # the sharpest that reaching a tip makes, before it is smoothed


def gap_to_close(mesh: Triangulation, surface: Surface) -> float:
    """From which width on gaps are worth closing."""
    if surface.gap < COARSE * np.linalg.norm(np.ptp(surface.vertices, axis=0)):
        return surface.gap
    return max(surface.gap, float(np.quantile(gaps_of(surface.probes, *mesh)[0], 1 - WIDEST)))


def reach(
    mesh: Triangulation, surface: Surface, gap: float, pinned: Bool[Any, "V"], probes: Int[Any, "N"]
) -> tuple[Triangulation, Bool[Any, "V"], Int[Any, "n"]]:
    """Move vertices onto the points of the surface that the mesh misses by far, and pin them there.

    Of two neighbours the one with the wider gap goes; pinned and boundary vertices stay, and a vertex goes
    only where the surface faces its way. `probes` are the points asked. Returns the mesh, which vertices are
    pinned now, and which probes to ask again, when the mesh has been smoothed.
    """
    vertices, faces = mesh[0].copy(), mesh[1]
    count = len(vertices)
    gaps, hit = gaps_of(surface.probes[probes], vertices, faces)
    again = probes[gaps > gap / 2]
    missed = np.flatnonzero(gaps > gap)
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


def tighten(mesh: Triangulation, surface: Surface, gap: float, rng: np.random.Generator) -> Triangulation:
    """Move vertices and flip edges at random where the mesh is far from the surface, the surface from it, or
    a corner sharp, and keep what makes the sum of squared excesses smaller.

    Only the surroundings of such places are looked at, so it costs little.
    """
    fit = fit_of(mesh, surface, gap)
    for lap in range(LAPS):
        sharp = fit.shapes.cosines > FAIR
        widen = lap < SHARP_LAPS or sharp.mean() > FEW_SHARP
        bad = fit.wide | sharp & widen
        if not bad.any():
            break
        for _ in range(RINGS):
            bad = _grown(bad, fit.faces, len(fit.vertices))
        rows = np.flatnonzero(bad)
        part, inside, asked = fit.cut(rows)
        for attempt in range(TRIES):
            wide = part.wide
            bad = wide | (part.shapes.cosines > FAIR) & widen
            if not bad.any():
                break
            loose = _grown(wide, part.faces, len(part.vertices))
            if attempt % 2:
                change = _flips(part, np.flatnonzero(bad), loose, rng)
            else:
                change = _moves(part, np.flatnonzero(bad), loose, surface, rng)
            _take_over(part, change, surface, gap)
        fit.vertices[inside], fit.faces[rows] = part.vertices, inside[part.faces]
        fit.shapes.put(rows, part.shapes)
        fit.gaps[asked], fit.hits[asked] = part.gaps, rows[part.hits]
    return Triangulation(fit.vertices, fit.faces)


class Change(NamedTuple):
    """A change of patches of a mesh, no two of which share a face."""

    vertices: Float64[Any, "V 3"]
    rows: Int[Any, "n"]  # the faces that change,
    faces: Int[Any, "n 3"]  # what they become,
    owners: Int[Any, "n"]  # and their patches
    size: int  # how many patches


def _take_over(fit, change, surface, gap):
    """Change the patches that cost less then."""
    rows, owners, size = change.rows, change.owners, change.size
    patch = np.full(len(fit.faces), -1)
    patch[rows] = owners
    asked = np.flatnonzero(patch[fit.hits] >= 0)
    by_probe = patch[fit.hits[asked]]
    faces = fit.faces.copy()
    faces[rows] = change.faces
    gaps, hits = gaps_of(fit.probes[asked], change.vertices, faces)
    gaps /= gap
    shapes = shapes_of(change.vertices, change.faces, surface, gap)
    before = _cost(fit.shapes.at(rows), owners, fit.gaps[asked], by_probe, size)
    better = _cost(shapes, owners, gaps, by_probe, size) < before
    better &= _sound(fit, change, surface.length)
    kept = better[owners]
    rows, faces = rows[kept], change.faces[kept]
    fit.vertices[faces], fit.faces[rows] = change.vertices[faces], faces
    fit.shapes.put(rows, shapes.at(kept))
    kept = better[by_probe]
    asked, gaps, hits = asked[kept], gaps[kept], hits[kept]
    # A neighbouring patch that came closer may be one that stays as it was.
    gone = np.flatnonzero(~np.append(better, True)[patch[hits]])
    gaps[gone], hits[gone] = gaps_of(fit.probes[asked[gone]], fit.vertices, fit.faces)
    gaps[gone] /= gap
    fit.gaps[asked], fit.hits[asked] = gaps, hits


def _cost(shapes, owners, gaps, by_probe, size):
    """Of each patch: squares of gaps beyond `EASY` and of cosines beyond `FAIR`, summed."""
    faces = shapes.excess + np.maximum(shapes.cosines - FAIR, 0) ** 2
    return np.bincount(owners, faces, size) + np.bincount(by_probe, np.maximum(gaps - EASY, 0) ** 2, size)


def _grown(faces_in, faces, count):
    """With all faces that share a vertex."""
    return any_of(mark(count, faces[faces_in]), faces)


def _moves(fit, bad, loose, surface, rng):
    """Stars of corners of bad faces, no two adjacent, their centres moved at random on the surface."""
    vertices, faces = fit.vertices, fit.faces
    count = len(vertices)
    goals = np.full((len(faces), 3), np.nan)
    missed = fit.gaps > 1
    goals[fit.hits[missed]] = fit.probes[missed]
    topo = topology(faces, count)
    kind = fit.kind.copy()
    rim = mark(count, topo.edges[topo.boundary].ravel())
    corners = faces[bad, rng.integers(3, size=len(bad))]
    asked, first = np.unique(corners, return_index=True)
    goals, loose = goals[bad[first]], loose[bad[first]]
    # A spike takes itself for a crease, and lands on none there is: some start anew amid their neighbours.
    anew = loose & (rng.random(len(asked)) < ANEW)
    kind[asked[anew]] = 0
    free = ~rim[asked] & ((kind[asked] < 2) | loose)
    free[free] = independent(topo.edges, count, asked[free], rng.permutation(int(free.sum())))
    asked, goals, anew = asked[free], goals[free], anew[free]
    stars = Stars(vertices, faces, asked)
    start = np.where(anew[:, None], stars.middles(vertices), vertices[asked])
    step = rng.normal(size=(len(asked), 3)) * (STEP * surface.length * rng.random(len(asked)))[:, None]
    step -= dot(step, stars.normals)[:, None] * stars.normals
    aimed = np.isfinite(goals[:, 0]) & (rng.random(len(asked)) < AIMED)
    share = rng.uniform(0.5, 1.5, (len(asked), 1))
    step[aimed] = (share * (goals - start))[aimed]
    landed, trusted = surface.land(start + step, stars.normals, kind[asked], rim[asked])
    there = aimed & (share[:, 0] > 1)
    landed[there], trusted[there] = goals[there], True
    moved = vertices.copy()
    moved[asked[trusted]] = landed[trusted]
    return Change(moved, stars.ids, stars.faces, stars.owners, len(asked))


def _flips(fit, bad, loose, rng):
    """Pairs of faces, one of each bad, no two of them touching, with their common edge flipped."""
    vertices, faces = fit.vertices, fit.faces
    count = len(vertices)
    topo = topology(faces, count)
    edges = np.unique(topo.face_edges[bad, rng.integers(3, size=len(bad))])
    free = ~all_of(fit.kind > 0, topo.edges) | mark(len(topo.edges), topo.face_edges[loose])
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
    return Change(vertices, rows.T.ravel(), turned, np.tile(np.arange(len(quads)), 2), len(quads))


def _sound(fit, change, length):
    """Whether the faces of a patch look one way, none is a needle and none too long, or about as before."""
    owners, size = change.owners, change.size
    states = ((fit.vertices, fit.faces[change.rows]), (change.vertices, change.faces))
    normals = [area_normals(*state) for state in states]
    mean = [unit_vectors(sum_at(owners[:, None], each, size)) for each in normals]
    down = [
        largest(owners, -dot(unit_vectors(each), np.take(main, owners, 0)), size)
        for each, main in zip(normals, mean, strict=True)
    ]
    sharp = [largest(owners, sharpest_cosines(*state), size) for state in states]
    long = [largest(owners, longest_sides(*state), size) for state in states]
    good = (down[1] < np.maximum(down[0], -UPRIGHT)) & (dot(*mean) > 0.3)
    good &= sharp[1] < np.maximum(sharp[0], NEEDLE)
    return good & (long[1] <= np.maximum(long[0], LONGEST * length))
