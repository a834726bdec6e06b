"""Closing the gaps between a remeshed copy and its surface, in both directions.

Smoothing slides vertices off the tips of spikes and off fillets narrower than an edge, and edges cut across
creases that bend too little or are too short to be features. First, `pin_missed_points` moves vertices to the
farthest points of the surface, while the copy can still be smoothed around them. Then `tighten` searches at
random for moves and flips that close the remaining gaps.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from flx.geometry.arrays import Rng, area_normals, dot, length_of, mark, sum_at, unit_vectors
from flx.geometry.remesh.deviation import EASY, distances_to_mesh, measure_faces, measure_mesh
from flx.geometry.remesh.operators import disjoint, edge_quads, flipped, ranks
from flx.geometry.remesh.smoothing import ReferenceSurface
from flx.geometry.remesh.stars import Stars, independent, largest, longest_sides, sharpest_cosines
from flx.geometry.topology import all_of, any_of, has_edge, topology
from flx.types import Triangulation, Vertices

LAPS, TRIES = 30, 8  # laps over the bad places of a mesh, and attempts at each place in a lap
SHARP_LAPS = 2  # laps in which faces that are merely sharp count as bad too
FEW_SHARP = 0.007  # share of sharp faces above which they count as bad in the later laps as well
# Share of sharp faces from which they never count as bad: bars and walls thinner than an edge have no others.
HOPELESS = 0.1
# The work of the search, in tries of a whole mesh (of `SMALL` faces at least). Beyond the first number, a lap
# that leaves more than `WORTH` of the cost is the last; beyond the second, the search ends. Of nine scans the
# hardest took 2.7. Seven are about 3 CPU seconds at 30,000 vertices.
PATIENCE, MOST, WORTH, SMALL = 3.0, 7.0, 0.95, 60_000
MARGIN_RINGS = 3  # rings of faces around the bad places that a lap works on
STEP = 0.6  # scale of the random moves, in wanted edge lengths
ANEW = 0.3  # share of the moves that start at the mean of the neighbours and ignore features
AIMED = 0.5  # share of the moves that aim at a point that the mesh misses, where there is one
COARSE = 3e-3  # allowed gap, as a share of the diagonal, from which a copy cannot follow every detail
WIDEST = 3e-3  # share of the gaps that such a copy closes, the widest; closing all would spoil its angles
LONGEST_EDGE = 1.7  # longest edge that the search may make, in wanted edge lengths
UPRIGHT = 0.1  # least cosine between the normals of a face and its patch
FAIR_COSINE = np.cos(np.radians(35.0))  # corners below 35° are penalised
NEEDLE_COSINE = np.cos(np.radians(10.0))  # no change may make a corner below 10°


def gap_to_close(mesh: Triangulation, surface: ReferenceSurface) -> float:
    """The width from which gaps are closed: the allowed one, or on a coarse copy a quantile of all gaps."""
    if surface.gap < COARSE * np.linalg.norm(np.ptp(surface.vertices, axis=0)):
        return surface.gap
    return max(surface.gap, float(np.quantile(distances_to_mesh(surface.probes, *mesh)[0], 1 - WIDEST)))


def pin_missed_points(
    mesh: Triangulation, surface: ReferenceSurface, gap: float, pinned: Bool[Any, "V"], probes: Int[Any, "N"]
) -> tuple[Triangulation, Bool[Any, "V"], Int[Any, "n"]]:
    """Move vertices onto the points of the surface that are farther than `gap` from the mesh; pin them there.

    Of two neighbouring vertices, the one with the wider gap moves. Pinned and boundary vertices stay, and a
    vertex moves only to where the surface faces the same way. `probes` are indices of the points to check.
    Returns the mesh, the vertices that are pinned now, and the probes to check again after smoothing.
    """
    vertices, faces = mesh[0].copy(), mesh[1]
    gaps, hit = distances_to_mesh(surface.probes[probes], vertices, faces)
    again = probes[gaps > gap / 2]
    missed = np.flatnonzero(gaps > gap)
    targets, outward = surface.probes[probes[missed]], surface.outward[probes[missed]]
    gaps = gaps[missed]
    topo = topology(faces, len(vertices))
    near = faces[hit[missed]]
    apart = np.stack([length_of(vertices[near[:, k]] - targets) for k in range(3)], 1)
    movers = np.take_along_axis(near, apart.argmin(1)[:, None], 1)[:, 0]
    open_ = ~topo.rim[movers] & ~pinned[movers] & (dot(area_normals(vertices, near), outward) > 0)
    widest = np.flatnonzero(open_)[np.argsort(-gaps[open_], kind="stable")]
    movers, first = np.unique(movers[widest], return_index=True)
    goals = widest[first]
    chosen = independent(topo, movers, ranks(-gaps[goals]))
    movers, goals = movers[chosen], goals[chosen]
    stars = Stars(vertices, faces, movers)
    moved = vertices.copy()
    moved[movers] = targets[goals]
    good = stars.keep_facing(moved, 0.1) & (stars.worst(sharpest_cosines(moved, stars.faces)) < NEEDLE_COSINE)
    vertices[movers[good]] = moved[movers[good]]
    return Triangulation(vertices, faces), pinned | mark(topo.count, movers[good]), again


def tighten(mesh: Triangulation, surface: ReferenceSurface, gap: float, rng: Rng) -> Triangulation:
    """Random local search: move vertices and flip edges, and keep the changes that lower the cost (`_cost`).

    The search covers only the surroundings of bad faces: far from the surface, missing a point of it by more
    than `gap`, or with a sharp corner. So it costs little; where most of a mesh is bad, its work is bounded.
    """
    fit = measure_mesh(mesh, surface, gap)
    whole, tried, cost = max(len(fit.faces), SMALL), 0, np.inf
    for lap in range(LAPS):
        sharp = fit.quality.cosines > FAIR_COSINE
        widen = sharp.mean() < HOPELESS and (lap < SHARP_LAPS or sharp.mean() > FEW_SHARP)
        bad = fit.wide | sharp & widen
        before, cost = cost, _whole_cost(fit)
        if not bad.any() or (tried > PATIENCE * whole and cost > WORTH * before):
            break
        for _ in range(MARGIN_RINGS):
            bad = _grown(bad, fit.faces, len(fit.vertices))
        rows = np.flatnonzero(bad)
        part, inside, probes = fit.submesh(rows)
        for attempt in range(TRIES):
            wide = part.wide
            bad = wide | (part.quality.cosines > FAIR_COSINE) & widen
            if not bad.any() or tried > MOST * whole:
                break
            tried += len(part.faces)
            loose = _grown(wide, part.faces, len(part.vertices))  # here, features may change too
            if attempt % 2:
                change = _flips(part, np.flatnonzero(bad), loose, rng)
            else:
                change = _moves(part, np.flatnonzero(bad), loose, surface, rng)
            _take_over(part, change, surface, gap)
        fit.vertices[inside], fit.faces[rows] = part.vertices, inside[part.faces]
        fit.quality.put(rows, part.quality)
        fit.gaps[probes], fit.hits[probes] = part.gaps, rows[part.hits]
    return Triangulation(fit.vertices, fit.faces)


class Change(NamedTuple):
    """A proposed change to patches of a mesh, no two of which share a face."""

    vertices: Vertices  # of the whole mesh, after the change
    rows: Int[Any, "n"]  # indices of the faces that change
    faces: Int[Any, "n 3"]  # their new corners
    owners: Int[Any, "n"]  # the patch of each
    size: int  # number of patches


def _take_over(fit, change, surface, gap):
    """Accept the change of each patch whose cost it lowers; updates `fit` in place."""
    rows, owners, size = change.rows, change.owners, change.size
    patch = np.full(len(fit.faces), -1)
    patch[rows] = owners
    probes = np.flatnonzero(patch[fit.hits] >= 0)
    by_probe = patch[fit.hits[probes]]
    faces = fit.faces.copy()
    faces[rows] = change.faces
    gaps, hits = distances_to_mesh(fit.probes[probes], change.vertices, faces)
    gaps /= gap
    quality = measure_faces(change.vertices, change.faces, surface, gap)
    before = _cost(fit.quality.at(rows), owners, fit.gaps[probes], by_probe, size)
    better = _cost(quality, owners, gaps, by_probe, size) < before
    better &= _sound(fit, change, surface.length)
    accepted = better[owners]
    rows, faces = rows[accepted], change.faces[accepted]
    fit.vertices[faces], fit.faces[rows] = change.vertices[faces], faces
    fit.quality.put(rows, quality.at(accepted))
    accepted = better[by_probe]
    probes, gaps, hits = probes[accepted], gaps[accepted], hits[accepted]
    # The closest face may belong to a neighbouring patch whose own change was rejected: measure again.
    gone = np.flatnonzero(~np.append(better, True)[patch[hits]])
    gaps[gone], hits[gone] = distances_to_mesh(fit.probes[probes[gone]], fit.vertices, fit.faces)
    gaps[gone] /= gap
    fit.gaps[probes], fit.hits[probes] = gaps, hits


def _cost(quality, owners, gaps, by_probe, size):
    """For each patch, the sum of squares of distances beyond `EASY` and of cosines beyond `FAIR_COSINE`."""
    faces = quality.excess + np.maximum(quality.cosines - FAIR_COSINE, 0) ** 2
    return np.bincount(owners, faces, size) + np.bincount(by_probe, np.maximum(gaps - EASY, 0) ** 2, size)


def _whole_cost(fit):
    faces, probes = (np.zeros(len(values), np.int64) for values in (fit.faces, fit.probes))
    return _cost(fit.quality, faces, fit.gaps, probes, 1)[0]


def _grown(marked, faces, count):
    """The marked faces and all that share a vertex with them."""
    return any_of(mark(count, faces[marked]), faces)


def _moves(fit, bad, loose, surface, rng):
    """Random moves, on the surface, of corners of bad faces, no two of them adjacent; a patch is a star."""
    vertices, faces = fit.vertices, fit.faces
    goals = np.full((len(faces), 3), np.nan)
    missed = fit.gaps > 1
    goals[fit.hits[missed]] = fit.probes[missed]
    topo = topology(faces, len(vertices))
    kind, rim = fit.kind.copy(), topo.rim
    corners = faces[bad, rng.integers(3, size=len(bad))]
    movers, first = np.unique(corners, return_index=True)
    goals, loose = goals[bad[first]], loose[bad[first]]
    # The edges of a spike look like creases that the surface does not have: some moves ignore features.
    anew = loose & (rng.random(len(movers)) < ANEW)
    kind[movers[anew]] = 0
    free = ~rim[movers] & ((kind[movers] < 2) | loose)
    free[free] = independent(topo, movers[free], rng.permutation(int(free.sum())))
    movers, goals, anew = movers[free], goals[free], anew[free]
    stars = Stars(vertices, faces, movers)
    start = np.where(anew[:, None], stars.middles(vertices), vertices[movers])
    step = stars.random_steps(STEP * surface.length, rng)
    aimed = np.isfinite(goals[:, 0]) & (rng.random(len(movers)) < AIMED)
    share = rng.uniform(0.5, 1.5, (len(movers), 1))
    step[aimed] = (share * (goals - start))[aimed]
    landed, on_own_side = surface.project(start + step, stars.normals, kind[movers], rim[movers])
    there = aimed & (share[:, 0] > 1)
    landed[there], on_own_side[there] = goals[there], True
    moved = vertices.copy()
    moved[movers[on_own_side]] = landed[on_own_side]
    return Change(moved, stars.ids, stars.faces, stars.owners, len(movers))


def _flips(fit, bad, loose, rng):
    """Random flips of edges of bad faces; a patch is the pair of faces at the edge, no two pairs touch."""
    vertices, faces = fit.vertices, fit.faces
    topo = topology(faces, len(vertices))
    edges = np.unique(topo.face_edges[bad, rng.integers(3, size=len(bad))])
    free = ~all_of(fit.kind > 0, topo.edges) | mark(len(topo.edges), topo.face_edges[loose])
    edges = edges[free[edges] & ~topo.boundary[edges]]
    quads, rows = edge_quads(topo, faces, edges)
    (a, b, p, q), valence = quads.T, topo.valence
    rim = topo.rim  # p and q may be joined outside this part
    good = (valence[a] > 3) & (valence[b] > 3) & ~(rim[p] & rim[q]) & ~has_edge(topo, p, q)
    quads, rows = quads[good], rows[good]
    chosen = disjoint(quads, topo.count, rng.random(len(quads)))
    owners = np.tile(np.arange(len(chosen)), 2)
    return Change(vertices, rows[chosen].T.ravel(), flipped(quads[chosen]), owners, len(chosen))


def _sound(fit, change, length):
    """Whether each patch has faces that agree in direction, no needle and no long edge, or gets no worse."""
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
    good &= sharp[1] < np.maximum(sharp[0], NEEDLE_COSINE)
    return good & (long[1] <= np.maximum(long[0], LONGEST_EDGE * length))
