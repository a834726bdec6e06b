"""Laws of anchors: points and logs are inverses, and a piece is the same wherever it is predicted from."""

import numpy as np
import pytest
from helpers.surfaces import icosphere, moved, square_grid, uneven_sphere
from hypothesis import given
from hypothesis import strategies as st

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
)
from flx.geometry.sampling import positions
from flx.geometry.tangent import corner_logs
from flx.types import SurfacePoints

BALL, GRID = Surface(icosphere(3)), Surface(square_grid(12))


def identity(surface: Surface) -> Anchors:
    count = len(surface)
    return Anchors(np.arange(count), np.zeros(count, np.complex64), np.ones(count, np.complex64))


@pytest.mark.parametrize("open", [False, True])
@given(seed=st.integers(0, 1000))
def test_points_have_the_logs_that_they_were_made_with(open, seed):
    surface = GRID if open else Surface(uneven_sphere(seed))
    rng, (vertices, faces) = np.random.default_rng(seed), surface.triangulation
    picked = rng.integers(0, len(faces), 50)
    points = SurfacePoints(picked, rng.dirichlet((1, 1, 1), 50))
    corner = rng.integers(0, 3, 50)
    logs = corner_logs(surface.frames, surface.triangulation, *points)[np.arange(50), corner]
    found = surface.points_at(faces[picked, corner], logs.astype(np.complex64))
    assert np.abs(positions(vertices, faces, found) - positions(vertices, faces, points)).max() < 1e-5


def test_a_point_beyond_the_ring_is_moved_to_its_border():
    centre = 5 * 12 + 5
    far = GRID.points_at(np.array([centre]), np.array([40 + 0j], np.complex64))
    place = positions(*GRID.triangulation, far)[0]
    assert np.isfinite(place).all() and np.linalg.norm(place - GRID.triangulation.vertices[centre]) < 0.15


def test_beyond_an_open_border_the_nearer_edge_is_taken():
    """In the middle of a side of a flat sheet, whose frame begins at one of the two edges."""
    vertex, length = 6, np.float32(1 / 11 / GRID.radius)
    first = GRID.frames.neighbors[vertex, 0]
    last = [n for n in GRID.frames.neighbors[vertex] if n >= 0][-1]
    for angle, toward in ((-0.2, first), (np.pi + 0.2, last)):
        log = length * np.exp(1j * np.array([angle])).astype(np.complex64)
        place = positions(*GRID.triangulation, GRID.points_at(np.array([vertex]), log))[0]
        along = GRID.positions[toward] - GRID.positions[vertex]
        assert np.abs(place - GRID.positions[vertex] - np.cos(0.2) * along).max() < 1e-5


@given(seed=st.integers(0, 1000))
def test_settling_keeps_the_place_and_the_direction(seed):
    """On a flat sheet, where space shows both exactly."""
    rng = np.random.default_rng(seed)
    vertices = (rng.integers(3, 9, 40) * 12 + rng.integers(3, 9, 40)).astype(np.int64)
    offsets = (3 * rng.random(40) * np.exp(2j * np.pi * rng.random(40))).astype(np.complex64)
    turns = np.exp(2j * np.pi * rng.random(40)).astype(np.complex64)
    before = Anchors(vertices, offsets, turns)
    after = settled(GRID, before)
    assert not np.array_equal(after.vertices, vertices), "some must have moved"
    for a, b in zip(placed(GRID, before), placed(GRID, after), strict=True):
        assert np.abs(a - b).max() < 1e-5
    apart = np.linalg.norm(placed(GRID, after)[0][:, None] - GRID.positions, axis=-1)
    here = apart[np.arange(40), after.vertices]
    assert (here <= apart.min(1) + 1e-6).all(), "the nearest vertex of all"


@pytest.mark.parametrize("surface", [BALL, GRID])
def test_neighbours_of_one_piece_predict_what_is_there(surface):
    own = identity(surface)
    says = predicted(surface, surface, own, 1.0, np.arange(len(surface)))
    used = surface.used
    assert (says.vertices == np.arange(len(surface))[:, None])[used].all()
    assert np.abs(says.offsets[used]).max() < 1e-5 and np.abs(says.turns[used] - 1).max() < 1e-5
    one = predicted(surface, surface, own, 1.0, np.arange(len(surface)), np.ones(len(surface), np.int64))
    assert (one.vertices == says.vertices[:, 1]).all()


@given(angle=st.floats(0, 6.28))
def test_a_turned_piece_predicts_turned_places(angle):
    """A sheet turned about its middle: every vertex predicts where its neighbours are turned to."""
    middle = np.array([6 * 12 + 6])
    turn = np.complex64(np.exp(1j * angle))
    rows = GRID.rings.neighbors[middle[0], 1:][GRID.used[middle[0], 1:]]
    own = identity(GRID)
    own.put(middle, Anchors(middle, np.zeros(1, np.complex64), np.array([turn])))
    slots = np.array([int((GRID.rings.neighbors[row] == middle[0]).argmax()) for row in rows])
    places = placed(GRID, predicted(GRID, GRID, own, 1.0, rows, slots))[0]
    away = (GRID.positions[rows] - GRID.positions[middle]) @ np.array([1, 1j, 0])
    found = (places - GRID.positions[middle]) @ np.array([1, 1j, 0])
    assert np.abs(found - turn * away).max() < 1e-5


def test_the_average_of_one_is_itself_and_others_are_told_apart():
    here = np.arange(len(BALL))
    own = identity(BALL)
    says = predicted(BALL, BALL, own, 1.0, here)
    mean, known = averaged(BALL, here, says, BALL.used)
    assert known.all() and (mean.vertices == here).all() and np.abs(mean.offsets).max() < 1e-5
    far = Anchors((here[:, None] + 300) % len(BALL), says.offsets[:, :1], says.turns[:, :1])
    assert not seen_from(BALL, here, far)[1].all()


@given(seed=st.integers(0, 100))
def test_a_moved_surface_has_the_same_rings_and_moved_places(seed):
    other = Surface(moved(BALL.triangulation, seed, 3.0))
    assert np.abs(other.rings.logs - BALL.rings.logs).max() < 1e-5
    own = identity(BALL)
    back = nearest_anchors(*placed(other, own), outward(other, own.vertices), other)
    assert (back.vertices == own.vertices).all()
    assert np.abs(back.offsets).max() < 1e-4 and np.abs(back.turns - 1).max() < 1e-4
