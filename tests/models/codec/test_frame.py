"""Laws of the encoder in a canonical frame, and of the components it starts from."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.codecs import FRAME, decode, encode, rings, trained_a_little, weights_of

from flx.fields import polynomials
from flx.models.codec import frame


def test_an_upright_ring_looks_the_same_in_every_frame():
    r = rings(12, samples=64)
    turn = np.exp(1j * np.random.default_rng(1).uniform(-np.pi, np.pi, 12)).astype(np.complex64)
    here, there = frame.upright(r), frame.upright(r._replace(logs=r.logs * turn[:, None]))
    np.testing.assert_allclose(there.scalars, here.scalars, atol=1e-5)
    np.testing.assert_allclose(there.vectors, here.vectors, atol=1e-4)
    np.testing.assert_allclose(there.direction, here.direction * turn, atol=1e-3)
    assert np.std(here.vectors) > 1e-2


def test_a_code_is_split_as_it_was_joined():
    r = frame.upright(rings(12))
    scalars, vectors = frame.split_code(frame.join_code(r.scalars[:, :6], r.vectors), 3)
    np.testing.assert_array_equal(scalars, r.scalars[:, :6])
    np.testing.assert_array_equal(vectors, r.vectors)


def test_components_are_measured_by_colours_where_samples_count():
    """The norm of coefficients in the metric is the weighted mean square of their polynomial."""
    logs = rings(200, samples=64).logs
    metric, _ = frame._metrics(logs)
    constant = polynomials.coefficient_rows(frame.FITTED_DEGREE)[0]
    terms = np.asarray(polynomials.basis(logs.ravel(), frame.FITTED_DEGREE), np.float64)[:, constant]
    coefficients = np.random.default_rng(0).normal(size=(len(constant), 3))
    expected = weights_of(logs.ravel()) @ ((terms @ coefficients) ** 2).sum(1)
    np.testing.assert_allclose(((coefficients.ravel() @ metric) ** 2).sum(), expected, rtol=1e-4)


@pytest.mark.slow
def test_principal_components_keep_more_than_any_mean():
    """Before any training the linear maps give most of a smooth ring back."""
    model, params = trained_a_little(replace(FRAME, samples=64, edges=1))
    r = rings(200, samples=64, seed=5, noise=0)
    back = decode(model, params, r.logs, encode(model, params, r).mean)
    assert np.mean((back - r.colors) ** 2) < 0.1 * np.mean((r.colors.mean(1, keepdims=True) - r.colors) ** 2)
