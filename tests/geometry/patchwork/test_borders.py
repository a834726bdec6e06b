"""Laws of borders: weights add up to 1, hang on no order of corners, and go over into each other at edges."""

import numpy as np
from helpers.surfaces import icosphere
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import csr_array

from flx.geometry.patchwork.borders import SHARPNESS, Belonging, corner_weights
from flx.types import Queries

BALL = icosphere(1)
COUNT = len(BALL.vertices)


def of_pieces(pieces, smooth):
    """Belonging to random pieces, as if it had been averaged with that of all others."""
    own = np.eye(pieces.max() + 1)[pieces]
    return Belonging(pieces, csr_array(((1 - smooth) * own + smooth * own.mean(0)).astype(np.float32)))


def queries(vertices, barycentrics):
    vertices = np.asarray(vertices, np.int32)
    return Queries(vertices, np.zeros(vertices.shape, np.complex64), np.asarray(barycentrics, np.float32))


@given(seed=st.integers(0, 1000), smooth=st.floats(0, 0.9))
def test_weights_add_up_to_1_and_the_order_of_corners_does_not_matter(seed, smooth):
    rng = np.random.default_rng(seed)
    of = of_pieces(rng.integers(0, 4, COUNT), smooth)
    at = queries(BALL.faces, rng.dirichlet((1, 1, 1), len(BALL.faces)))
    weights = corner_weights(of, at)
    assert np.abs(weights.sum(1) - 1).max() < 1e-5 and weights.min() >= 0
    order = rng.permuted(np.tile(np.arange(3), (len(at.vertices), 1)), axis=1)
    turned = queries(
        *(np.take_along_axis(np.asarray(part), order, 1) for part in (at.vertices, at.barycentrics))
    )
    assert np.abs(corner_weights(of, turned) - np.take_along_axis(weights, order, 1)).max() < 1e-5


@given(seed=st.integers(0, 1000), along=st.floats(0.01, 0.99))
def test_at_an_edge_the_corner_across_counts_nothing(seed, along):
    """So two faces agree there, whatever the pieces of the two corners across."""
    rng = np.random.default_rng(seed)
    of = of_pieces(rng.integers(0, 3, COUNT), 0.6)
    edges = np.roll(BALL.faces, seed, axis=1)
    at = np.tile([along, 1 - along, 0], (len(edges), 1))
    weights = corner_weights(of, queries(edges, at))
    assert weights[:, 2].max() == 0
    beside = at * (1 - 1e-4) + [0, 0, 1e-4]
    assert corner_weights(of_pieces(of.pieces, 0.9), queries(edges, beside))[:, 2].max() < 0.5, "nor suddenly"
    pairs = {}
    for (first, second, _), (one, other, _) in zip(edges, weights, strict=True):
        pairs[first, second] = one
        if (second, first) in pairs and along == 0.5:
            assert abs(pairs[second, first] - other) < 1e-5


def test_inside_a_piece_the_nearest_corner_counts_most():
    at = queries(BALL.faces, np.random.default_rng(0).dirichlet((1, 1, 1), len(BALL.faces)))
    powers = at.barycentrics**SHARPNESS
    weights = corner_weights(of_pieces(np.zeros(COUNT, int), 0.5), at)
    assert np.abs(weights - powers / powers.sum(1, keepdims=True)).max() < 1e-6


def test_a_border_between_two_pieces_runs_where_both_are_as_much():
    """A vertex whose ring is of another piece gives way to it, the more the smoother."""
    pieces = np.zeros(COUNT, int)
    pieces[BALL.faces[0, 0]] = 1
    at = queries(BALL.faces[:1], [[0.6, 0.2, 0.2]])
    kept, lost = (corner_weights(of_pieces(pieces, smooth), at)[0, 0] for smooth in (0.0, 0.5))
    assert kept > 0.9 and lost < 0.1
