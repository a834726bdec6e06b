"""The anchors whose surroundings fit best: the neighbours' predictions, and the most similar places of all.

Lefebvre and Hoppe (2006) and Barnes et al. (2009) let good matches spread to neighbours in this way; the
price that overused parts of the source have is that of Houdard et al. (2021), for its regions.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Int

from flx.geometry.arrays import chunks
from flx.geometry.patchwork.anchors import Anchors, Surface, placed
from flx.geometry.patchwork.appearance import ANGLES, Charts, Source

ROWS = 1000  # charts compared at a time
COMPONENTS = 64  # principal ones that charts are compared by, where all are searched
LOOKED = 1500  # source vertices, at most, that such a search looks at
APART, ALIKE = 0.5, 0.8  # edges, and cosine: two predictions closer than both agree
CENTRE = 0.2  # weight of the samples that the vertex itself decides


def distances(
    source: Source, charts: Charts, candidates: Anchors, weights: Float32[Any, "n 24 4"] | None = None
) -> Float32[Any, "n K"]:
    """The squared distance of each chart from those of its candidates, turned as they say."""
    shift = _shift(candidates)
    flat = source.charts.reshape(-1, *source.charts.shape[2:])  # by vertex · ANGLES + angle
    result = np.empty(shift.shape, np.float32)
    for rows in chunks(len(result), ROWS):
        angles = (shift[rows][..., None] + np.arange(ANGLES)) % ANGLES
        there = flat[candidates.vertices[rows][..., None] * ANGLES + angles]
        squares = np.square(there - charts[rows][:, None]).sum(-1)
        if weights is not None:
            squares *= weights[rows][:, None]
        result[rows] = squares.sum((2, 3))
    return result


def _shift(anchors: Anchors) -> Int[Any, "*N"]:
    return np.round(np.angle(anchors.turns) / (2 * np.pi) * ANGLES).astype(np.int64) % ANGLES


class Bank(NamedTuple):
    """The charts of some source vertices in every turn, by their principal components."""

    vertices: Int[Any, "M"]
    mean: Float32[Any, "C"]
    components: Float32[Any, "C 64"]
    charts: Float32[Any, "24M 64"]  # turn by turn
    squares: Float32[Any, "24M"]


def bank(source: Source, rng: np.random.Generator) -> Bank:
    """The charts of at most `LOOKED` vertices, chosen at random."""
    vertices = np.sort(rng.permutation(np.flatnonzero(source.usable))[:LOOKED])
    charts = source.charts[vertices]
    flat = np.concatenate([np.roll(charts, -turn, 1).reshape(len(charts), -1) for turn in range(ANGLES)])
    mean = flat.mean(0)
    flat -= mean
    some = flat[:: max(1, len(flat) // 20_000)]
    components = np.ascontiguousarray(np.linalg.eigh(some.T @ some)[1][:, ::-1][:, :COMPONENTS])
    charts = flat @ components
    return Bank(vertices, mean, components, charts, np.einsum("mc,mc->m", charts, charts))


def most_similar(
    bank: Bank,
    charts: Charts,
    count: int = 1,
    prices: Float32[Any, "G M"] | None = None,
    groups: Int[Any, "n"] | None = None,
) -> tuple[Int[Any, "n count"], Int[Any, "n count"]]:
    """Places in `bank.vertices`, and turns, of the most similar charts, the best first.

    `prices` of the bank's charts are added to the squared distances: the row that `groups` names.
    """
    queries = (charts.reshape(len(charts), -1) - bank.mean) @ bank.components
    added = bank.squares[None] if prices is None else bank.squares + prices
    best = np.empty((len(charts), count), np.int64)
    for rows in chunks(len(charts), 256):
        chosen = added if groups is None or len(added) == 1 else added[groups[rows]]
        apart = chosen - 2 * queries[rows] @ bank.charts.T
        if count == 1:
            best[rows] = apart.argmin(1)[:, None]
            continue
        some = np.argpartition(apart, count, axis=1)[:, :count]
        order = np.take_along_axis(apart, some, 1).argsort(1)
        best[rows] = np.take_along_axis(some, order, 1)
    turns, places = np.divmod(best, len(bank.vertices))
    return places, turns


def anchors_of(bank: Bank, places: Int[Any, "*N"], turns: Int[Any, "*N"]) -> Anchors:
    """The anchors that `most_similar` found."""
    unit = np.exp(2j * np.pi * turns / ANGLES).astype(np.complex64)
    return Anchors(bank.vertices[places], np.zeros_like(unit), unit)


def support(
    source: Surface, candidates: Anchors, counted: Bool[Any, "n K"], edge: float
) -> Float32[Any, "n K"]:
    """The share of the counted candidates, without the first, that each candidate agrees with.

    `edge`: the length of an edge of the target in mean vertex radii of the source.
    """
    positions, directions = placed(source, candidates)
    positions = positions / np.float32(APART * edge * source.radius)
    centred = positions - positions[:, :1]
    squares = np.einsum("nkx,nkx->nk", centred, centred)
    apart = squares[:, :, None] + squares[:, None] - 2 * centred @ centred.transpose(0, 2, 1)
    agree = (apart < 1) & (directions @ directions.transpose(0, 2, 1) > ALIKE) & counted[:, None]
    others = np.maximum(counted[:, 1:].sum(1), 1)
    return (agree[:, :, 1:].sum(-1) / others[:, None]).astype(np.float32)


class Usage:
    """How often parts of a source are used, and the prices that follow."""

    def __init__(self, source: Surface, *divisions: Int[Any, "V"]) -> None:
        """`divisions`: ways to divide the source into parts, each by the number of every vertex's part."""
        self.divisions = divisions
        total = source.frames.masses.sum()
        self.areas = [np.bincount(parts, source.frames.masses) / total for parts in divisions]

    def prices(self, anchors: Anchors, masses: Any) -> Float32[Any, "V"]:
        """Of the source's vertices: the logarithm of how much too often their parts are used."""
        prices = np.zeros(len(self.divisions[0]), np.float32)
        for parts, areas in zip(self.divisions, self.areas, strict=True):
            used = np.bincount(parts[anchors.vertices], masses / masses.sum(), len(areas))
            excess = np.log(np.maximum(used / np.maximum(areas, 1e-9), 0.1))
            prices += excess[parts].astype(np.float32)
        return prices
