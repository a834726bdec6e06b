"""Laws of comparing charts: turns do not count, copies are seen, distances are those of a plain loop."""

import numpy as np
import pytest

from flx.evaluation import patches
from flx.evaluation.charts import ANGLES, RINGS


@pytest.fixture
def charts():
    rng = np.random.default_rng(0)
    smooth = np.cumsum(np.cumsum(rng.normal(size=(12, RINGS, ANGLES, 3)), 1), 2)
    return ((smooth - smooth.min()) / np.ptp(smooth)).astype(np.float32)


def test_distances_are_the_least_over_all_turns(charts):
    described = patches.describe(charts)
    found = patches.distances(patches.spectra(described[:5]), patches.spectra(described[5:]))
    for n, query in enumerate(described[:5]):
        for m, other in enumerate(described[5:]):
            turned = [np.linalg.norm(query - np.roll(other, k, 1)) for k in range(ANGLES)]
            assert found[n, m] == pytest.approx(min(turned), rel=1e-3)
    assert found.min() > 1


def test_a_turned_chart_is_the_same_chart(charts):
    turned = patches.spectra(patches.describe(np.roll(charts, 11, axis=2)))
    found = patches.distances(patches.spectra(patches.describe(charts)), turned)
    assert found.diagonal().max() < 0.2 < found[~np.eye(len(charts), dtype=bool)].min()


def test_a_flat_difference_is_measured_in_steps_of_a_byte():
    grey = np.full((1, RINGS, ANGLES, 3), 0.4, np.float32)
    found = patches.distances(*(patches.spectra(patches.describe(c)) for c in (grey, grey + 10 / 255)))
    assert found[0, 0] == pytest.approx(10, rel=0.01)


def test_copies_are_charts_of_the_same_place_unturned(charts):
    old = patches.describe(charts)
    far = np.full((len(charts), 3), 5.0, np.float32)
    assert patches.copied(old, old, far).all()
    assert patches.copied(np.roll(old, 1, axis=2), old, far).all()
    assert not patches.copied(np.roll(old, 9, axis=2), old, far).any()
    assert not patches.copied(old[::-1], old, far).any()


def test_coverage_counts_what_was_made(charts):
    rng = np.random.default_rng(1)
    own = rng.uniform(1, 2, (50, 20)).astype(np.float32)
    assert patches.coverage(own, own) == 1
    assert patches.coverage(own, own + 5) == 0
    half = np.concatenate([own[:25], own[25:] + 5])
    assert patches.coverage(own, half) == 0.5


def test_sliced_wasserstein_is_zero_for_the_same_and_grows_with_a_shift():
    rng = np.random.default_rng(2)
    a, b = (rng.normal(size=(20_000, 1)) for _ in range(2))
    assert patches.sliced_wasserstein(a, a, rng) == 0
    assert patches.sliced_wasserstein(a, b, rng) < 0.04
    assert patches.sliced_wasserstein(b + 0.5, b, rng) == pytest.approx(0.5, rel=0.02)


@pytest.mark.parametrize("count", [1, 2, 7, 1000])
def test_quantiles_are_those_of_numpy(count):
    values = np.random.default_rng(count).normal(size=(count, 3))
    wanted = np.quantile(values, (np.arange(16) + 0.5) / 16, axis=0)
    np.testing.assert_allclose(patches.quantiles(values, 16), wanted, rtol=1e-12, atol=1e-12)
