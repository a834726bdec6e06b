"""Seams between pieces of a source, moved to where they show least by minimal cuts.

A piece is a set of connected vertices whose anchors agree. An edge between two vertices costs what their
anchors say differently of its points, so an edge inside a piece costs nothing. A piece may take over the
vertices around it (alpha expansion: Boykov, Veksler and Zabih 2001), and a new one may be set where seams are
expensive (Kwatra et al. 2003); a minimal cut says exactly which vertices change sides, and never costs more
than what was there before.
"""

from collections.abc import Callable, Iterable
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy.sparse import csr_array, csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, maximum_flow

from flx.geometry.patchwork.anchors import (
    Anchors,
    Surface,
    nearest_anchors,
    outward,
    placed,
    predicted,
)
from flx.geometry.patchwork.appearance import EDGE, VALUES, Charts, Source, Views, seen
from flx.geometry.patchwork.search import ALIKE, APART, Bank, anchors_of, most_similar

PLACES = np.array([0.0, 0.5, 1.0], np.float32)  # of an edge where its two ends are compared
RIM = 6  # rings around a piece that it may take over
LENGTH = 0.02  # cost of a seam's edge, beside the colours; without it seams fray in flat areas
DIFFERENT = 0.03  # difference of colours from which on an edge counts as a seam
FLAT = 0.2  # share of a difference that costs the same wherever it is
FIXED = 1e3  # cost of what may not change
PRECISION = 2000.0  # flow through a difference of 1
SMALL = 3  # vertices; smaller pieces do not expand, they are taken over
BATCH = 25  # places where new pieces are tried at a time
TRIES, CHOICE = 2, 40  # pieces that are tried at each, and of how many they are chosen

Priced = Callable[[Charts, Int[Any, "n"]], tuple[Any, ...]]


class Patchwork:
    """Anchors at the vertices of a target, and what they show along its edges."""

    def __init__(
        self,
        source: Source,
        target: Surface,
        anchors: Anchors,
        step: float,
        free: Bool[Any, "V"],
        misfit: Callable[[Anchors, Int[Any, "n"]], Float32[Any, "n"]] | None = None,
    ) -> None:
        """`anchors` are changed in place, those of `free` vertices alone; `step` as in `predicted`.

        `misfit` is what the anchors of some rows cost beside seams.
        """
        self.misfit = misfit or (lambda _, rows: np.zeros(len(rows), np.float32))
        self.source, self.target, self.anchors, self.step, self.free = source, target, anchors, step, free
        p, slot = np.nonzero(target.used)
        self.p, self.slot = p[slot > 0], slot[slot > 0]
        self.q = target.rings.neighbors[self.p, self.slot]
        self.back = target.rings.reverse[self.p, self.slot]

    @cached_property
    def shown(self) -> Float32[Any, "V K 3 4"]:
        """What the anchors of all vertices say, kept up to date by `grow`."""
        return self.along(self.anchors, np.arange(len(self.target)))

    def along(self, anchors: Anchors, rows: Int[Any, "n"]) -> Float32[Any, "n K 3 4"]:
        """What the anchors of some rows say of the points along their edges."""
        logs = self.target.rings.logs[rows][..., None] * PLACES * np.float32(self.step)
        shape = (*logs.shape, VALUES)
        vertices, offsets, turns = (np.asarray(part)[:, None, None] for part in anchors)
        there = Anchors(np.broadcast_to(vertices, logs.shape), offsets + turns * logs, turns + 0 * logs)
        return self.source.look(there).reshape(shape)

    def cost(
        self, a: Float32[Any, "E 3 4"], b: Float32[Any, "E 3 4"], busy: Float32[Any, "E"]
    ) -> Float32[Any, "E"]:
        """What edges cost whose ends say `a` and `b`, in parts of the source that are `busy` so much.

        A difference is seen less where much is going on (Kwatra et al. 2003): if it cost the same
        everywhere, flat parts of a texture, which resemble anything best, would replace all others.
        """
        difference = _seam(a, b) / (FLAT + (1 - FLAT) * busy)
        return difference + np.float32(LENGTH) * (difference > DIFFERENT)

    def costs(self) -> Float32[Any, "E"]:
        """Of all edges, both ways."""
        return _seam(self.shown[self.p, self.slot], self.shown[self.q, self.back])

    def pieces(self) -> Int[Any, "V"]:
        """The number of each vertex's piece."""
        source, target = self.source.surface, self.target
        theirs = predicted(source, target, self.anchors, self.step, np.arange(len(target)))
        (there, toward), (here, own) = placed(source, theirs), placed(source, self.anchors)
        near = np.linalg.norm(there - here[:, None], axis=-1) < APART * EDGE * target.radius * self.scale
        alike = near & (np.einsum("vkx,vx->vk", toward, own) > ALIKE)
        together = alike[self.p, self.slot]
        edges = self.p[together], self.q[together]
        graph = csr_array((np.ones(len(edges[0])), edges), shape=(len(target),) * 2)
        return connected_components(graph, directed=False)[1]

    @property
    def scale(self) -> float:
        """Units of the source in one of the target: not 1 where details are made larger or smaller."""
        return self.step * self.source.surface.radius / self.target.radius

    def expand(self, rng: np.random.Generator) -> None:
        """Let every piece, in random order, take over what it can better."""
        pieces = self.pieces()
        sizes = np.bincount(pieces)
        for piece in rng.permutation(len(sizes)):
            members = np.flatnonzero(pieces == piece)
            if len(members) >= SMALL:
                pieces[self.grow(members)] = piece

    def insert(
        self,
        bank: Bank,
        coarse: Source,
        view: Views,
        count: int,
        rng: np.random.Generator,
        priced: Priced = lambda *_: (),
    ) -> None:
        """Try new pieces at `count` vertices, chosen by what the seams around them cost.

        `view` gives the charts that the bank's are compared with; the bank's vertices are those of `coarse`.
        `priced` says what charts of the bank cost beside, as `most_similar` takes it.
        """
        for _ in range(max(1, count // BATCH)):
            costs = np.bincount(self.p, self.costs(), len(self.target))
            costs = np.maximum(costs - 1.5 * np.median(costs), 0) * self.free
            costs += np.bincount(self.p, costs[self.q], len(self.target)) * self.free
            if np.count_nonzero(costs) < BATCH:
                return
            rows = rng.choice(len(self.target), BATCH, replace=False, p=costs / costs.sum())
            for row, choices in zip(rows, self._choices(rows, bank, coarse, view, priced), strict=True):
                for choice in choices:
                    self.grow(np.array([row]), choice)

    def _choices(
        self, rows: Int[Any, "n"], bank: Bank, coarse: Source, view: Views, priced: Priced
    ) -> Iterable[list[Anchors]]:
        """New anchors for each row, of different places of the source."""
        source = self.source.surface
        charts: Charts = seen(self.source, view, self.anchors, self.step, rows)
        found = anchors_of(bank, *most_similar(bank, charts, CHOICE, *priced(charts, rows)))
        positions, directions = placed(coarse.surface, found)
        normals = outward(coarse.surface, found.vertices)
        converted = nearest_anchors(
            positions.reshape(-1, 3), directions.reshape(-1, 3), normals.reshape(-1, 3), source
        )
        edge = EDGE * self.target.radius * self.scale
        for number, row in enumerate(rows):
            taken = [placed(source, self.anchors.at(row))[0]]
            chosen = []
            for place, position in enumerate(positions[number]):
                apart = [np.linalg.norm(position - other) for other in taken]
                if min(apart) > 2 * edge and len(chosen) < TRIES:
                    taken.append(position)
                    chosen.append(converted.at(number * CHOICE + place))
            yield chosen

    def grow(self, members: Int[Any, "n"], start: Anchors | None = None) -> Int[Any, "m"]:
        """Extend one piece by `RIM` rings and cut: the vertices that change sides.

        The piece is that of the members; or a new one, whose anchor at the one member is `start`.
        """
        new, distance = self._extended(members, start)
        region = np.flatnonzero(distance >= 0)
        shown = self.along(new.at(region), region)
        place = np.full(len(self.target), -1)
        place[region] = np.arange(len(region))
        p, slot = np.nonzero(self.target.used[region])
        p, slot = p[slot > 0], slot[slot > 0]
        q = place[self.target.rings.neighbors[region[p], slot]]
        back = self.target.rings.reverse[region[p], slot]
        old_only = ~self.free[region] | ~self.source.can_give(new.at(region))
        old_only[p[q < 0]] = True  # outside, everything stays
        if start is None:
            old_only &= distance[region] > 0
        once = p < q
        p, slot, q, back = p[once], slot[once], q[once], back[once]
        old = self.shown[region]
        busy = self.source.busy
        sides = (old, busy[self.anchors.vertices[region]]), (shown, busy[new.vertices[region]])
        costs = [
            self.cost(a[p, slot], b[q, back], (around[p] + there[q]) / 2)
            for a, around in sides
            for b, there in sides
        ]
        worse = self.misfit(new.at(region), region) - self.misfit(self.anchors.at(region), region)
        takes = _cut(p, q, costs, worse, old_only, (distance[region] == 0) & (start is None))
        changed = region[takes & (distance[region] > 0 if start is None else True)]
        self.anchors.put(changed, new.at(changed))
        self.shown[changed] = shown[place[changed]]
        return changed

    def _extended(self, members: Int[Any, "n"], start: Anchors | None) -> tuple[Anchors, Int[Any, "V"]]:
        """Anchors that agree with the piece, and how many rings from it each vertex is (−1: too many)."""
        target, source = self.target, self.source.surface
        anchors = Anchors(*(part.copy() for part in self.anchors))
        if start is not None:
            anchors.put(members, start)
        distance, front = np.full(len(target), -1), members
        distance[members] = 0
        for ring in range(1, RIM + 1):
            around = np.unique(target.rings.neighbors[front][target.used[front]])
            around = around[distance[around] < 0]
            if not len(around):
                break
            counted = (distance[target.rings.neighbors[around]] >= 0) & target.used[around]
            counted[:, 0] = False
            anchors.put(around, predicted(source, target, anchors, self.step, around, counted.argmax(1)))
            distance[around], front = ring, around
        return anchors, distance


def _seam(a: Float32[Any, "*E 3 4"], b: Float32[Any, "*E 3 4"]) -> Float32[Any, "*E"]:
    """The mean difference along edges, seen from their two ends."""
    return np.sqrt(np.square(a - b[..., ::-1, :]).sum(-1)).mean(-1)


def _cut(
    p: Int[Any, "E"],
    q: Int[Any, "E"],
    costs: list[Float[Any, "E"]],
    worse: Float[Any, "N"],
    old_only: Bool[Any, "N"],
    new_only: Bool[Any, "N"],
) -> Bool[Any, "N"]:
    """Which vertices take the new, so that the costs are least.

    Those of an edge are for old-old, old-new, new-old and new-new at p and q; `worse` is by how much the new
    is at each vertex alone.
    Kolmogorov and Zabih (2004): a sum of terms of one vertex, and of one that only p old, q new pays.
    """
    count = len(old_only)
    old_old, old_new, new_old, new_new = costs
    pays_new, pays_old = np.maximum(worse, 0.0), np.maximum(-worse, 0.0)
    for at, extra in ((p, new_old - old_old), (q, new_new - new_old)):
        pays_new += np.bincount(at, np.maximum(extra, 0), count)
        pays_old += np.bincount(at, np.maximum(-extra, 0), count)
    pays_new[old_only] += FIXED
    pays_old[new_only] += FIXED
    between = np.maximum(old_new + new_old - old_old - new_new, 0)
    old, new, every = count, count + 1, np.arange(count)
    rows = np.concatenate([np.full(count, old), every, p])
    columns = np.concatenate([every, np.full(count, new), q])
    capacity = np.minimum(np.concatenate([pays_new, pays_old, between]) * PRECISION, 2e8).astype(np.int32)
    graph = csr_matrix((capacity, (rows, columns)), shape=(count + 2, count + 2))
    left = csr_matrix(graph - maximum_flow(graph, old, new).flow)
    left.data = np.maximum(left.data, 0)
    left.eliminate_zeros()
    takes = np.ones(count + 2, bool)
    takes[breadth_first_order(left, old, return_predecessors=False)] = False
    return takes[:count]
