"""Laws of guides: labels go where they belong, directions turn with the target, frames do not matter."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from geometry.patchwork.test_synthesis import BALL, WHOLE, synthesis_of
from helpers.surfaces import icosphere, square_grid

from flx.geometry.direction import field_on
from flx.geometry.patchwork.anchors import Anchors, Surface, placed
from flx.geometry.patchwork.guides import (
    LIFTED,
    REACHED,
    STOREYS,
    TURNED,
    Character,
    Guides,
    Weights,
    character,
    chart_costs,
    curvature,
    unlike,
)
from flx.geometry.patchwork.search import anchors_of
from flx.geometry.patchwork.synthesis import Level, synthesize
from flx.types import Triangulation


def upper(triangulation: Triangulation) -> np.ndarray:
    return (triangulation.vertices[:, 2] > 0).astype(np.int32)


def right(triangulation: Triangulation) -> np.ndarray:
    return (triangulation.vertices[:, 0] > 0).astype(np.int32)


def test_a_label_is_filled_from_the_same_label_of_the_input():
    """What was above goes to the right, unless labels count nothing."""
    guided = synthesis_of(BALL, guides=(Guides(labels=upper), Guides(labels=right)))
    level = guided.levels[-1]
    wanted = level.target.positions[:, 0] > 0
    edge = np.abs(level.target.positions[:, 0]) < 0.1
    shares = []
    for weight in (1.0, 0.0):
        places = placed(level.source.surface, synthesize(guided, 0, weights=Weights(others=weight)))[0]
        shares.append(((places[:, 2] > 0) == wanted)[~edge].mean())
    assert shares[0] > 0.97 and shares[1] < 0.8


def test_labels_in_another_order_and_guidance_0_change_nothing():
    """By number labels mean nothing, and at weight 0 they are not there."""

    def anchors(number: Callable[[Any], Any], weight: float = 1.0) -> Anchors:
        def labelled(level: Level) -> Level:
            sides = (level.source.surface, upper), (level.target, right)
            one, other = (
                character(surface, Guides(lambda t, of=of: number(of(t)).astype(np.int32)))
                for surface, of in sides
            )
            return level._replace(characters=(one, other))

        guided = WHOLE._replace(levels=tuple(map(labelled, WHOLE.levels)))
        return synthesize(guided, 0, weights=Weights(others=weight))

    told, again = anchors(lambda n: n), anchors(lambda n: 7 - n)
    none, ignored = synthesize(WHOLE, 0), anchors(lambda n: n, 0.0)
    for one, two in ((told, again), (none, ignored)):
        for a, b in zip(one, two, strict=True):
            np.testing.assert_array_equal(a, b)
    assert (told.vertices != none.vertices).mean() > 0.3


@pytest.mark.parametrize("degrees", [0, 90])
def test_directions_of_the_input_follow_those_of_the_target(degrees):
    """At right angles no large piece can follow: meridians spread out, circles of latitude do not."""
    turn = np.exp(1j * np.deg2rad(degrees))
    along = Guides(direction=lambda t: field_on("z", t))
    turned = Guides(direction=lambda t: turn * field_on("z", t))
    guided = synthesis_of(BALL, guides=(along, turned))
    free, off = (
        deviations(guided.levels[-1].characters, synthesize(guided, 0, weights=Weights(others=weight)))
        for weight in (0.0, 1.0)
    )
    assert (off < 45).mean() > 0.85 and np.median(off) < 20
    assert (free < 45).mean() < 0.5


def deviations(characters: tuple[Character, Character], anchors: Anchors) -> np.ndarray:
    """Degrees between each direction of the target and the one that comes to it."""
    source, target = characters
    along = np.conj(source.directions[anchors.vertices]) * anchors.turns * target.directions
    return np.rad2deg(np.abs(np.angle(along[np.abs(along) > 0.5])))


def heights_of_both(characters: tuple[Character, Character], anchors: Anchors) -> np.ndarray:
    source, target = characters
    return np.stack([source.heights[anchors.vertices], target.heights])


def test_pieces_stay_at_their_height_where_they_are_told_to():
    """From 0 to 1 on both surfaces: a rim comes from the rim."""
    guided = synthesis_of(BALL, guides=(Guides(height="z"), Guides(height="z")))
    characters = guided.levels[-1].characters
    for each in characters:
        assert each.heights.min() == 0 and each.heights.max() == 1
    free, told = (
        heights_of_both(characters, synthesize(guided, 0, weights=Weights(others=weight)))
        for weight in (0.0, 1.0)
    )
    assert np.median(np.abs(told[0] - told[1])) < 0.06 and np.corrcoef(told)[0, 1] > 0.95
    assert np.corrcoef(free)[0, 1] < 0.5


@pytest.mark.parametrize("height", [None, "z"])
def test_charts_cost_what_their_anchors_cost(height):
    """But for curvature, and for half a turn's step and half a storey by which rows of a group may differ."""
    guides = Guides(upper, lambda t: field_on("z", t), height)
    level = synthesis_of(BALL, guides=(guides, guides)).levels[-1]
    bank, rows = level.bank, np.arange(0, len(level.target), 23)
    costs, groups = chart_costs(bank, *level.characters, rows, Weights(others=2.0))
    places = np.tile(np.arange(len(bank.vertices)), 24)
    turns = np.repeat(np.arange(24), len(bank.vertices))
    anchors = anchors_of(bank, places, turns)
    for number, row in enumerate(rows):
        exact = unlike(*level.characters, anchors, np.full(len(places), row), Weights(0.0, 2.0))
        turned, lifted = TURNED / 2 * np.deg2rad(7.5), 2 * LIFTED / REACHED * 0.5 / STOREYS if height else 0
        assert np.abs(costs[groups[number]] - exact).max() < 2 * (turned + lifted) + 1e-4


def test_frames_of_the_two_surfaces_do_not_matter():
    """Directions turn with a frame, and so does an anchor."""
    rng, count = np.random.default_rng(0), 50
    units = [np.exp(2j * np.pi * rng.random(count)).astype(np.complex64) for _ in range(4)]
    flat, labels, rows = np.zeros(count, np.float32), np.zeros(count, np.int32), np.arange(count)
    source, target = (Character(flat, labels, unit, flat) for unit in units[:2])
    anchors = Anchors(rng.permutation(count), np.zeros(count, np.complex64), units[2])
    before = unlike(source, target, anchors, rows, Weights())
    turn = units[3]
    other = target._replace(directions=target.directions * turn)
    assert np.abs(unlike(source, other, anchors, rows, Weights()) - before).max() > 1
    moved = anchors._replace(turns=anchors.turns / turn)
    assert np.abs(unlike(source, other, moved, rows, Weights()) - before).max() < 1e-5
    theirs = source._replace(directions=source.directions * turn)
    moved = anchors._replace(turns=anchors.turns * turn[anchors.vertices])
    assert np.abs(unlike(theirs, target, moved, rows, Weights()) - before).max() < 1e-5


def test_nothing_is_asked_where_there_is_no_direction():
    one, none = np.ones(2, np.complex64), np.zeros(2, np.complex64)
    flat, labels, rows = np.zeros(2, np.float32), np.zeros(2, np.int32), np.arange(2)
    anchors = Anchors(rows, none, -one)
    there, nowhere = (Character(flat, labels, unit, flat) for unit in (one, none))
    assert unlike(there, there, anchors, rows, Weights()) == pytest.approx(TURNED)
    assert not unlike(there, nowhere, anchors, rows, Weights()).any()
    assert not unlike(nowhere, there, anchors, rows, Weights()).any()


def test_curvature_is_that_of_balls_inside_and_out():
    ball = icosphere(3)
    hollow = Triangulation(ball.vertices, ball.faces[:, ::-1])
    for shape, bend in ((ball, np.arcsinh(1)), (hollow, -np.arcsinh(1)), (square_grid(9), 0)):
        assert np.abs(curvature(Surface(shape)) - bend).max() < 0.02
