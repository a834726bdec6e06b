"""Laws of cuts: the least of all cuts, by trying them all; taking pieces over never costs more."""

import itertools

import numpy as np
import pytest
from helpers.surfaces import icosphere
from helpers.textured import noise, textured
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from flx.geometry.patchwork.anchors import Anchors, Surface
from flx.geometry.patchwork.appearance import EDGE, REACH, Source
from flx.geometry.patchwork.cuts import Patchwork, _cut
from flx.geometry.remesh.remesh import remesh

BALL = icosphere(3)


def painted():
    corners = BALL.vertices[BALL.faces]
    uvs = corners[..., :2] * 0.45 + 0.5
    return textured(BALL, uvs, gaussian_filter(noise(128, 128), (3, 3, 0)))


MESH = painted()
SOURCE = Source(MESH, Surface(remesh(BALL.vertices, BALL.faces, 1200, 1)), 2 * REACH * EDGE, 0)
TARGET = Surface(remesh(BALL.vertices, BALL.faces, 300, 2))
STEP = TARGET.radius / SOURCE.surface.radius


def patchwork(seed: int, pieces: int = 300) -> Patchwork:
    rng = np.random.default_rng(seed)
    vertices = rng.integers(0, len(SOURCE.surface), pieces)[np.arange(300) % pieces]
    turns = np.exp(2j * np.pi * rng.random(300)).astype(np.complex64)
    anchors = Anchors(vertices, np.zeros(300, np.complex64), turns)
    return Patchwork(SOURCE, TARGET, anchors, STEP, np.ones(300, bool))


@given(seed=st.integers(0, 10_000))
def test_no_other_cut_is_cheaper(seed):
    rng, count = np.random.default_rng(seed), 6
    p, q = np.array([(i, j) for i in range(count) for j in range(i + 1, count) if rng.random() < 0.6]).T
    old_new, new_old = rng.random((2, len(p)))
    old_old, new_new = rng.random((2, len(p))) * (old_new + new_old) / 2  # as for distances
    costs = [old_old, old_new, new_old, new_new]
    worse, old_only, new_only = rng.normal(size=count), np.arange(count) == 0, np.arange(count) == 1

    def cost(takes):
        of = np.stack(costs)[2 * takes[p] + takes[q], np.arange(len(p))].sum()
        return of + worse[takes].sum()

    allowed = [
        np.array(each) for each in itertools.product([False, True], repeat=count) if not each[0] and each[1]
    ]
    found = _cut(p, q, costs, worse, old_only, new_only)
    assert not found[0] and found[1]
    assert cost(found) <= min(map(cost, allowed)) + 0.02, "flows are whole numbers of 1/2000"


@settings(max_examples=4)
@given(seed=st.integers(0, 1000))
def test_taking_over_makes_seams_cheaper(seed):
    work, rng = patchwork(seed), np.random.default_rng(seed)
    costs = [work.costs().sum()]
    for _ in range(3):
        member = rng.integers(0, 300, 1)
        work.grow(member)
        costs.append(work.costs().sum())
        work.grow(rng.integers(0, 300, 1), work.anchors.at(rng.integers(0, 300)))
        costs.append(work.costs().sum())
    assert costs[-1] < 0.98 * costs[0]
    shown = work.along(work.anchors, np.arange(300))
    assert np.abs(shown - work.shown).max() < 1e-6, "what is shown is what the anchors say"


def test_a_difference_is_dearer_in_flat_parts():
    work, rng = patchwork(1), np.random.default_rng(1)
    a, b = rng.random((2, 9, 3, 4), np.float32)
    flat, usual, busy = (work.cost(a, b, np.full(9, much, np.float32)) for much in (0.1, 1, 3))
    assert (flat > 3 * usual).all() and (busy < 0.5 * usual).all()
    assert np.abs(work.cost(a, a[:, ::-1], np.ones(9, np.float32))).max() == 0, "inside a piece"


def test_what_is_not_free_stays():
    work = patchwork(3)
    work.free[:] = np.arange(300) % 2 == 0
    before = Anchors(*(part.copy() for part in work.anchors))
    for vertex in range(0, 300, 10):
        work.grow(np.array([vertex]))
    changed = work.anchors.vertices != before.vertices
    assert changed[::2].any() and not changed[1::2].any()


def test_one_piece_is_one_and_has_no_seams():
    target = SOURCE.surface
    count = len(target)
    own = Anchors(np.arange(count), np.zeros(count, np.complex64), np.ones(count, np.complex64))
    whole = Patchwork(SOURCE, target, own, 1.0, np.ones(count, bool))
    assert whole.pieces().max() == 0 and whole.costs().max() < 0.03
    assert patchwork(0).pieces().max() > 100


@pytest.mark.parametrize("heavy", [False, True])
def test_a_misfit_is_not_taken(heavy):
    work = patchwork(5)
    start = work.anchors.vertices.copy()
    if heavy:
        work.misfit = lambda anchors, rows: 100.0 * (anchors.vertices != start[rows])
    for vertex in range(0, 300, 30):
        work.grow(np.array([vertex]))
    assert (work.anchors.vertices == start).all() == heavy
