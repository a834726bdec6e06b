"""What pieces should share with the places that they come to: curvature, labels and direction."""

from collections.abc import Callable
from typing import Any, NamedTuple

import igl
import numpy as np
from jaxtyping import Complex64, Complex128, Float32, Int, Int32

from flx.geometry.patchwork.anchors import Anchors, Surface, outward
from flx.geometry.patchwork.appearance import ANGLES
from flx.geometry.patchwork.search import Bank
from flx.types import Triangulation

MOST_BENT = 4.0  # squared difference of curvatures that counts
OTHER = 10.0  # cost of another label
TURNED = 10.0  # cost of the opposite direction; half as much at right angles


class Guides(NamedTuple):
    """How to find labels and directions at the vertices of any triangulation of a surface."""

    labels: Callable[[Triangulation], Int32[Any, "V"]] | None = None
    direction: Callable[[Triangulation], Complex128[Any, "V"]] | None = None

    def turned(self, degrees: float) -> "Guides":
        """The same with directions turned counter-clockwise, seen from outside."""
        if (direction := self.direction) is None:
            return self
        unit = np.exp(1j * np.deg2rad(degrees))
        return self._replace(direction=lambda triangulation: unit * direction(triangulation))


class Character(NamedTuple):
    """What the vertices of a triangulation are like. Where nothing is known, labels or directions are 0."""

    bends: Float32[Any, "V"]
    labels: Int32[Any, "V"]
    directions: Complex64[Any, "V"]  # unit numbers in the frames of the vertices, or 0


class Weights(NamedTuple):
    """How much it counts that a piece is like the place that it comes to."""

    bends: float = 1.0
    others: float = 1.0  # of labels and directions


def character(surface: Surface, guides: Guides) -> Character:
    """What the vertices of a surface are like."""
    count, triangulation = len(surface), surface.triangulation
    labels = guides.labels(triangulation) if guides.labels else np.zeros(count, np.int32)
    directions = guides.direction(triangulation) if guides.direction else np.zeros(count)
    return Character(curvature(surface), labels, directions.astype(np.complex64))


def curvature(surface: Surface) -> Float32[Any, "V"]:
    """asinh of the mean curvature times the radius of a ball of the surface's area: 0.88 on a ball."""
    vertices, faces = surface.triangulation
    faces = faces.astype(np.int64)
    masses = np.maximum(surface.frames.masses, 1e-300)
    normals = (igl.cotmatrix(vertices, faces) @ vertices) / masses[:, None]
    mean = -np.einsum("vx,vx->v", normals, outward(surface, np.arange(len(surface)))) / 2
    mean[surface.frames.boundary] = 0
    bend = np.arcsinh(mean * np.sqrt(masses.sum() / (4 * np.pi)))
    for _ in range(2):
        bend = np.einsum("vk,vk->v", bend[surface.rings.neighbors], surface.rings.weights)
    return bend.astype(np.float32)


def unlike(
    source: Character, target: Character, anchors: Anchors, rows: Int[Any, "..."], weights: Weights
) -> Float32[Any, "..."]:
    """The cost of anchors whose places are unlike the vertices of the target that they are for."""
    there = anchors.vertices
    cost = weights.bends * np.minimum((source.bends[there] - target.bends[rows]) ** 2, MOST_BENT)
    cost = cost + weights.others * OTHER * (source.labels[there] != target.labels[rows])
    turned = _turned(source.directions[there], anchors.turns, target.directions[rows])
    return (cost + weights.others * turned).astype(np.float32)


def _turned(
    theirs: Complex64[Any, "..."], turns: Complex64[Any, "..."], own: Complex64[Any, "..."]
) -> Float32[Any, "..."]:
    """The cost of a direction that a turn makes of another one; none where either is 0."""
    along = (np.conj(theirs) * turns * own).real
    return TURNED * (np.abs(theirs) * np.abs(own) - along) / 2


def chart_costs(
    bank: Bank, source: Character, target: Character, rows: Int[Any, "n"], weights: Weights
) -> tuple[Float32[Any, "G M"], Int[Any, "n"]]:
    """What each chart of a bank costs by labels and direction, at groups of rows that are alike.

    And the group of each row. Directions are alike within half a step of the charts' turns.
    """
    of, own = target.labels[rows], target.directions[rows]
    steps = np.round(np.angle(own) / (2 * np.pi) * ANGLES).astype(np.int64) % ANGLES
    steps = np.where(np.abs(own) > 0, steps, -1)
    groups, group = np.unique(np.stack([of, steps], 1), axis=0, return_inverse=True)
    turns = np.repeat(np.exp(2j * np.pi * np.arange(ANGLES) / ANGLES), len(bank.vertices)).astype(
        np.complex64
    )
    labels, directions = (np.tile(part[bank.vertices], ANGLES) for part in source[1:])
    costs = np.empty((len(groups), len(turns)), np.float32)
    for number, (label, step) in enumerate(groups):
        unit = np.complex64(np.exp(2j * np.pi * step / ANGLES) * (step >= 0))
        costs[number] = OTHER * (labels != label) + _turned(directions, turns, unit)
    return weights.others * costs, group.reshape(-1)
