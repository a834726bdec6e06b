"""A new texture as a patchwork of an old one, from coarse to fine.

At the coarsest level a chart covers about a third of the surface, so that its layout is decided as a whole;
each finer level starts from the one before. In a level, vertices adopt the anchor whose surroundings in the
source resemble most what is around them now, with a preference for what their neighbours predict. At the
finest level seams are moved by minimal cuts. What comes out is anchors, not colours: every map of the source
can be looked up there at its full resolution.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Int
from scipy.spatial import KDTree

from flx.geometry.arrays import face_areas
from flx.geometry.patchwork.anchors import (
    Anchors,
    Surface,
    averaged,
    nearest_anchors,
    outward,
    placed,
    predicted,
    seen_from,
    settled,
    turned_frames,
)
from flx.geometry.patchwork.appearance import ANGLES, EDGE, REACH, Charts, Source, Views, seen, views
from flx.geometry.patchwork.cuts import Patchwork
from flx.geometry.patchwork.guides import Character, Guides, Weights, character, chart_costs, unlike
from flx.geometry.patchwork.search import (
    CENTRE,
    Bank,
    Usage,
    anchors_of,
    bank,
    distances,
    most_similar,
    support,
)
from flx.geometry.remesh.remesh import remesh
from flx.geometry.sampling import transfer
from flx.geometry.tangent import corner_logs
from flx.types import SurfacePoints, TexturedMesh, Triangulation

COARSEST = 150  # vertices: a chart then covers about a third of the surface
RATIO = 4.0  # most vertices of a level for one of the level before
FINER = 4  # vertices of a source for one of its target
SWEEPS = (24, 16, 16, 8)  # of the coarsest level, the next, …; the last number holds for all finer ones
SEARCHED = (12, 2)  # first sweeps of the coarsest level, and of the others, that search all of the source
AGREEMENT = 2.0  # weight of agreement with neighbours, in median distances, at coherence 1
PRICE = 3.0  # weight of the price of overused parts, in median distances
PARTS, TONES = 128, 32  # of the source, by place and by what it looks like, whose use is counted
INSERTED = 0.05  # new pieces that are tried for each vertex at coherence 1
EXPANSIONS = (1, 2)  # rounds before new pieces are tried, and after
RELAXATIONS = 8  # rounds that even out the anchors inside pieces
FORBIDDEN = 1e3  # cost of what a source cannot give
MISFIT, PRICED = 0.05, 0.1  # cost, beside seams, of a difference of curvature of 1, and of a price of 1
STAYING, NEAR = 4.0, 2.0  # cost of a place that does not move, as for MISFIT; it moves by so many edges
CLOSE = 0.7  # edges between two predictions that are averaged


USUAL = Weights()


class Level(NamedTuple):
    """Source and target of one size."""

    source: Source
    target: Surface
    view: Views
    bank: Bank
    usage: Usage
    step: float  # as in `predicted`
    characters: tuple[Character, Character]  # of source and target
    same: bool  # whether both are of one surface, so that a place could stay as it was


class Synthesis(NamedTuple):
    """All that is made once for many textures of one target."""

    levels: tuple[Level, ...]
    wide: Views  # charts of the finest target as large as those of the level before
    free: Bool[Any, "V"]  # vertices of the finest target that may change; others come from their own place


def level_counts(finest: int) -> list[int]:
    """Vertices of the levels."""
    steps = max(1, int(np.ceil(np.log(finest / COARSEST) / np.log(RATIO)))) if finest > COARSEST else 0
    counts = [round(COARSEST * (finest / COARSEST) ** (k / steps)) for k in range(steps)] if steps else []
    return [*counts, finest]


def prepare(
    mesh: TexturedMesh,
    triangulation: Triangulation,
    seed: int,
    scale: float = 1.0,
    shape: Triangulation | None = None,
    free: Bool[Any, "V"] | None = None,
    damaged: TexturedMesh | None = None,
    same: bool = True,
    guides: tuple[Guides, Guides] = (Guides(), Guides()),
) -> Synthesis:
    """Levels of a textured mesh, for textures on a triangulation of it, or of another mesh.

    Args:
        mesh: The source, with filled gutters.
        triangulation: The finest target.
        seed: Of all triangulations.
        scale: Size of details on the target; 2 makes them twice as large.
        shape: The surface that the triangulation is one of, if it is not `mesh`.
        free: Its vertices that may change; the others come from their own place. All, unless given.
        damaged: The mesh with white texels where nothing may be taken from.
        same: Whether the triangulation is one of `mesh`.
        guides: Of the mesh, and of the target.

    Levels too coarse for the surface's parts and holes are left out.
    """
    surface = shape or Triangulation(mesh.vertices, mesh.faces)
    finest, levels, parts = len(triangulation.vertices), [], None
    ratio = face_areas(mesh.vertices, mesh.faces).sum() / face_areas(*triangulation).sum() * scale**2
    for number, count in enumerate(level_counts(finest)):
        last = count == finest
        try:
            target = triangulation if last else remesh(surface.vertices, surface.faces, count, seed + number)
            copy = remesh(mesh.vertices, mesh.faces, round(FINER * count * ratio), seed + 1000 + number)
            target, copy = Surface(target), Surface(copy)
            step = target.radius / scale / copy.radius
            source = Source(mesh, copy, REACH * EDGE * step, seed + number, damaged, last)
        except ValueError:
            if last:
                raise
            continue
        rng = np.random.default_rng([seed, number])
        if parts is None:
            parts = copy.positions[rng.permutation(len(copy))[:PARTS]]
        tones = source.values[rng.permutation(len(copy))[:TONES]]
        levels.append(
            Level(
                source,
                target,
                views(target, REACH * EDGE),
                bank(source, rng),
                Usage(copy, _nearest(parts, copy.positions), _nearest(tones, source.values)),
                step,
                (character(copy, guides[0]), character(target, guides[1])),
                same,
            )
        )
    target = levels[-1].target
    wider = levels[max(len(levels) - 2, 0)].target.radius / target.radius
    wide = views(target, REACH * EDGE * wider)
    return Synthesis(tuple(levels), wide, np.ones(len(target), bool) if free is None else free)


def synthesize(
    synthesis: Synthesis, seed: int | list[int], coherence: float = 1.0, weights: Weights = USUAL
) -> Anchors:
    """Anchors at the vertices of the finest target. The same seed gives the same bits on the same machine.

    Args:
        coherence: 0 takes the best match at every vertex; the larger, the larger the pieces.
        weights: Of what vertices are like: rims come from rims, labels from their like.
    """
    rng, levels, free = np.random.default_rng(seed), synthesis.levels, synthesis.free
    if not free.any():
        return own_places(levels[-1])
    anchors = _anywhere(levels[0], rng)
    for number, level in enumerate(levels):
        if number:
            anchors = _refined(levels[number - 1], level, anchors)
        changing = np.arange(len(level.target))
        if level is levels[-1] and not free.all():
            anchors.put(~free, own_places(level).at(~free))
            changing = np.flatnonzero(free)
        for sweep in range(SWEEPS[min(number, len(SWEEPS) - 1)]):
            half = rng.permutation(changing)[: (len(changing) + 1) // 2]
            _improve(level, anchors, half, coherence, weights, sweep < SEARCHED[min(number, 1)])
    level, coarse = levels[-1], levels[max(len(levels) - 2, 0)]
    relax(level, anchors, free)
    if coherence:

        def misfit(there: Anchors, rows: Int[Any, "n"]) -> Float32[Any, "n"]:
            prices = level.usage.prices(anchors, level.target.frames.masses)
            extra = unlike(*level.characters, there, rows, weights) + _staying(level, there, rows)
            return MISFIT * extra + PRICED * prices[there.vertices]

        def priced(charts: Charts, rows: Int[Any, "n"]) -> tuple[Float32[Any, "G M"], Int[Any, "n"]]:
            sides = coarse.characters[0], level.characters[1]
            prices, groups = chart_costs(coarse.bank, *sides, rows, weights)
            return _spread(charts) * prices, groups

        work = Patchwork(level.source, level.target, anchors, level.step, free, misfit)
        for _ in range(EXPANSIONS[0]):
            work.expand(rng)
        tried = round(min(INSERTED / coherence, 1) * len(level.target))
        work.insert(coarse.bank, coarse.source, synthesis.wide, tried, rng, priced)
        for _ in range(EXPANSIONS[1]):
            work.expand(rng)
        relax(level, anchors, free)
    missing = np.flatnonzero(free & ~level.source.can_give(anchors))
    if len(missing):
        _improve(level, anchors, missing, coherence, weights, search=True)
    return anchors


def _nearest(centres: Float32[Any, "N C"], points: Float32[Any, "V C"]) -> Int[Any, "V"]:
    """The number of the centre that each point is nearest to."""
    return np.asarray(KDTree(centres).query(points)[1])


def _anywhere(level: Level, rng: np.random.Generator) -> Anchors:
    source, count = level.source, len(level.target)
    shares = source.surface.frames.masses * source.usable
    vertices = rng.choice(len(shares), count, p=shares / shares.sum())
    turns = np.exp(2j * np.pi * rng.random(count)).astype(np.complex64)
    return Anchors(vertices, np.zeros(count, np.complex64), turns)


def _improve(
    level: Level, anchors: Anchors, rows: Int[Any, "n"], coherence: float, weights: Weights, search: bool
) -> None:
    """Some vertices adopt the best of their candidates, in place."""
    source, target, step = level.source, level.target, level.step
    charts = seen(source, level.view, anchors, step, rows)
    candidates, counted = predicted(source.surface, target, anchors, step, rows), target.used[rows]
    agreed = support(source.surface, candidates, counted, EDGE * step)
    prices = PRICE * level.usage.prices(anchors, target.frames.masses)
    if search:
        costs, groups = chart_costs(level.bank, *level.characters, rows, weights)
        costs = _spread(charts) * (costs + np.tile(prices[level.bank.vertices], ANGLES))
        found = anchors_of(level.bank, *most_similar(level.bank, charts, prices=costs, groups=groups))
        candidates = Anchors(*(np.concatenate(both, 1) for both in zip(candidates, found, strict=True)))
        counted = np.pad(counted, ((0, 0), (0, 1)), constant_values=True)
        agreed = np.pad(agreed, ((0, 0), (0, 1)))
    own = np.where(level.view.owners[rows] == rows[:, None, None], np.float32(CENTRE), np.float32(1))
    apart = distances(source, charts, candidates, own)
    unit = np.median(apart[:, 0]) + np.float32(1e-6)
    costs = apart + unit * (AGREEMENT * coherence * (1 - agreed) + prices[candidates.vertices])
    costs += unit * unlike(*level.characters, candidates, rows[:, None], weights)
    costs += unit * _staying(level, candidates, rows[:, None])
    costs[~source.can_give(candidates)] += FORBIDDEN
    costs[~counted] = np.inf
    anchors.put(rows, candidates.at((np.arange(len(rows)), costs.argmin(1))))


def _staying(level: Level, anchors: Anchors, rows: Int[Any, "..."]) -> Float32[Any, "..."]:
    """The cost of anchors that lead to the place that their row is at."""
    if not level.same:
        return np.zeros(anchors.vertices.shape, np.float32)
    return np.float32(STAYING) * _near(level, placed(level.source.surface, anchors)[0], rows)


def _near(level: Level, positions: Any, rows: Int[Any, "..."]) -> Bool[Any, "..."]:
    """Which positions are close to where their rows are."""
    away = positions - level.target.positions[rows]
    return np.square(away).sum(-1) < (NEAR * EDGE * level.target.radius) ** 2


def _spread(charts: Charts) -> np.float32:
    """A small share of the squared distance between two charts."""
    return np.float32(np.median(np.square(charts - charts.mean(0)).sum((1, 2, 3))) / 4)


def _refined(coarse: Level, fine: Level, anchors: Anchors) -> Anchors:
    """The anchors of a coarse target at the vertices of a finer one."""
    target, before = fine.target, coarse.target
    hits = _vertices_on(target, before)
    nearest, each = hits.barycentrics.argmax(1), np.arange(len(target))
    owners = before.triangulation.faces[hits.faces, nearest]
    logs = corner_logs(before.frames, before.triangulation, *hits)[each, nearest].astype(np.complex64)
    turn = turned_frames(target, each, before, owners)
    of = anchors.at(owners)
    there = of.moved(logs, coarse.step)._replace(turns=of.turns * turn)
    there = settled(coarse.source.surface, there)
    normals = outward(coarse.source.surface, there.vertices)
    return nearest_anchors(*placed(coarse.source.surface, there), normals, fine.source.surface)


def _vertices_on(surface: Surface, other: Surface) -> SurfacePoints:
    """The vertices of one surface on another."""
    first = np.unique(surface.triangulation.faces.ravel(), return_index=True)[1]
    points = SurfacePoints(first // 3, np.eye(3)[first % 3])
    return transfer(points, surface.triangulation, other.triangulation)


def relax(level: Level, anchors: Anchors, free: Bool[Any, "V"]) -> None:
    """Average what neighbours of the same piece predict, so that its map is smooth; in place."""
    source, target = level.source.surface, level.target
    rows = np.flatnonzero(free)
    for _ in range(RELAXATIONS):
        says, own = predicted(source, target, anchors, level.step, rows), anchors.at(rows)
        theirs, known = seen_from(source, own.vertices, says)
        near = np.abs(theirs.offsets - own.offsets[:, None]) < CLOSE * EDGE * level.step
        alike = (theirs.turns * np.conj(own.turns[:, None])).real > 0.6
        mean, some = averaged(source, own.vertices, says, near & alike & known & target.used[rows])
        anchors.put(rows[some], mean.at(some))


def own_places(level: Level) -> Anchors:
    """Anchors that take every vertex of the finest target from its own place, unturned."""
    target = level.target
    normals = outward(target, np.arange(len(target)))
    return nearest_anchors(target.positions, target.x_axes, normals, level.source.surface)


def patchwork(synthesis: Synthesis, anchors: Anchors) -> Patchwork:
    """The pieces of a result, and what they show along the edges of the finest target."""
    level = synthesis.levels[-1]
    return Patchwork(level.source, level.target, anchors, level.step, synthesis.free)


class Pieces(NamedTuple):
    """What a patchwork consists of."""

    count: int
    largest: float  # share of the surface
    mean: float  # size of the piece of a point, averaged over the surface
    copied: float | None  # share of the surface that comes from its own place, unturned; None on another


def pieces(synthesis: Synthesis, anchors: Anchors) -> Pieces:
    """The pieces of a result."""
    level = synthesis.levels[-1]
    of = patchwork(synthesis, anchors).pieces()
    masses = level.target.frames.masses / level.target.frames.masses.sum()
    sizes = np.bincount(of, masses)
    positions, directions = placed(level.source.surface, anchors)
    near = _near(level, positions, np.arange(len(positions)))
    same = near & ((directions * level.target.x_axes).sum(1) > 0.9)
    copied = float(masses[same].sum()) if level.same else None
    return Pieces(len(sizes), float(sizes.max()), float((sizes**2).sum()), copied)
