"""What pieces should share with the places that they come to: curvature, labels, direction and height."""

from collections.abc import Callable
from typing import Any, NamedTuple

import igl
import numpy as np
from jaxtyping import Complex64, Complex128, Float32, Float64, Int, Int32

from flx.geometry.patchwork.anchors import Anchors, Surface, outward
from flx.geometry.patchwork.appearance import ANGLES
from flx.geometry.patchwork.search import Bank
from flx.types import Triangulation

MOST_BENT = 4.0  # squared difference of curvatures that counts
OTHER = 20.0  # cost of another label
TURNED = 20.0  # cost of the opposite direction; half as much at right angles
LIFTED = 20.0  # cost of another height, from a difference of REACHED of the whole on
REACHED = 0.25
STOREYS = 10  # heights that charts are compared at
AXES = ("x", "y", "z")


class Guides(NamedTuple):
    """What is height on a surface, and how to find labels and directions at vertices of a triangulation."""

    labels: Callable[[Triangulation], Int32[Any, "V"]] | None = None
    direction: Callable[[Triangulation], Complex128[Any, "V"]] | None = None
    height: str | None = None  # the axis along which pieces stay where they were: x, y or z

    def turned(self, degrees: float) -> "Guides":
        """The same with directions turned counter-clockwise, seen from outside."""
        if (direction := self.direction) is None:
            return self
        unit = np.exp(1j * np.deg2rad(degrees))
        return self._replace(direction=lambda triangulation: unit * direction(triangulation))


class Character(NamedTuple):
    """What the vertices of a triangulation are like. What is not known is 0 everywhere."""

    bends: Float32[Any, "V"]
    labels: Int32[Any, "V"]
    directions: Complex64[Any, "V"]  # unit numbers in the frames of the vertices, or 0
    heights: Float32[Any, "V"]  # from 0 to 1


class Weights(NamedTuple):
    """How much it counts that a piece is like the place that it comes to."""

    bends: float = 1.0
    others: float = 1.0  # of labels, directions and heights


def character(surface: Surface, guides: Guides) -> Character:
    """What the vertices of a surface are like."""
    count, triangulation = len(surface), surface.triangulation
    labels = guides.labels(triangulation) if guides.labels else np.zeros(count, np.int32)
    directions = guides.direction(triangulation) if guides.direction else np.zeros(count)
    heights = relative_heights(triangulation.vertices, guides.height) if guides.height else np.zeros(count)
    return Character(curvature(surface), labels, directions.astype(np.complex64), heights.astype(np.float32))


def relative_heights(points: Float64[Any, "V 3"], axis: str) -> Float64[Any, "V"]:
    """Coordinates along an axis, as shares of the way from the lowest to the highest of these points."""
    along = points[:, AXES.index(axis)]
    return (along - along.min()) / max(np.ptp(along), 1e-300)


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
    lifted = _lifted(source.heights[there], target.heights[rows])
    return (cost + weights.others * (turned + lifted)).astype(np.float32)


def _lifted(theirs: Float32[Any, "..."], own: Float32[Any, "..."] | np.float32) -> Float32[Any, "..."]:
    """The cost of one height for another one."""
    return LIFTED * np.minimum(np.square((theirs - own) / REACHED), 1)


def _turned(
    theirs: Complex64[Any, "..."], turns: Complex64[Any, "..."], own: Complex64[Any, "..."]
) -> Float32[Any, "..."]:
    """The cost of a direction that a turn makes of another one; none where either is 0."""
    along = (np.conj(theirs) * turns * own).real
    return TURNED * (np.abs(theirs) * np.abs(own) - along) / 2


def chart_costs(
    bank: Bank, source: Character, target: Character, rows: Int[Any, "n"], weights: Weights
) -> tuple[Float32[Any, "G M"], Int[Any, "n"]]:
    """What each chart of a bank costs by labels, direction and height, at groups of rows that are alike.

    And the group of each row: directions within half a step of the charts' turns, heights on one storey.
    """
    of, own = target.labels[rows], target.directions[rows]
    storeys = np.minimum(target.heights[rows] * STOREYS, STOREYS - 1).astype(np.int64)
    steps = np.round(np.angle(own) / (2 * np.pi) * ANGLES).astype(np.int64) % ANGLES
    steps = np.where(np.abs(own) > 0, steps, -1)
    groups, group = np.unique(np.stack([of, steps, storeys], 1), axis=0, return_inverse=True)
    turns = np.repeat(np.exp(2j * np.pi * np.arange(ANGLES) / ANGLES), len(bank.vertices)).astype(
        np.complex64
    )
    labels, directions, heights = (np.tile(part[bank.vertices], ANGLES) for part in source[1:])
    costs = np.empty((len(groups), len(turns)), np.float32)
    rising = np.ptp(source.heights) > 0
    for number, (label, step, storey) in enumerate(groups):
        unit = np.complex64(np.exp(2j * np.pi * step / ANGLES) * (step >= 0))
        costs[number] = OTHER * (labels != label) + _turned(directions, turns, unit)
        if rising:
            costs[number] += _lifted(heights, np.float32((storey + 0.5) / STOREYS))
    return weights.others * costs, group.reshape(-1)
