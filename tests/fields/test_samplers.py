"""Laws of the samplers: the reverse steps are the exact posterior, and find what the denoiser knows."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from flx.fields import diffusion, samplers
from flx.fields.algebra import tangent_noise


def of_gaussian(spread: float):
    """The exact denoiser of Z ~ N(0, s²), which is linear."""
    alphas = jnp.asarray(ALPHAS, jnp.float32)

    def exact(z, t):
        alpha = alphas[t.astype(int)]
        return z * jnp.sqrt(1 - alpha) / (alpha * spread**2 + 1 - alpha)

    return exact


ALPHAS = diffusion.linear_schedule(1000, 1e-4, 2e-2)
SAMPLERS = {
    "ancestral": samplers.ancestral(ALPHAS),
    "ddim": samplers.ddim(ALPHAS, 20),
    "dpm": samplers.dpm_solver(ALPHAS, 20),
}


def test_ancestral_steps_are_the_gaussian_posterior():
    """q(z_{t−1} | z_t, z_0) by completing the square, with z_0 = (z_t − √(1−α_t) ε)/√α_t put in."""
    steps = samplers.ancestral(ALPHAS).table
    for k in (0, 1, 500, 998):
        now, before = ALPHAS[steps["t"][k]], ALPHAS[steps["s"][k]]
        a = now / before
        precision = 1 / (1 - before) + a / (1 - a)
        of_z0, of_zt = np.sqrt(before) / (1 - before) / precision, np.sqrt(a) / (1 - a) / precision
        np.testing.assert_allclose(steps["c1"][k], of_zt + of_z0 / np.sqrt(now), rtol=1e-9)
        np.testing.assert_allclose(steps["c2"][k], -of_z0 * np.sqrt((1 - now) / now), rtol=1e-9)
        np.testing.assert_allclose(steps["c3"][k], np.sqrt(1 / precision), rtol=1e-9)


def test_last_step_adds_no_noise():
    steps = samplers.ancestral(ALPHAS).table
    assert steps["t"][-1] == 1 and steps["c3"][-1] == 0 and steps["c3"][0] > 0.1


@pytest.mark.parametrize("name", SAMPLERS)
def test_the_exact_denoiser_of_one_point_returns_that_point(name):
    point = tangent_noise(jax.random.key(0), (7, 3))
    alphas = jnp.asarray(ALPHAS, jnp.float32)

    def exact(z, t):
        alpha = alphas[t.astype(int)]
        return (z - jnp.sqrt(alpha) * point) / jnp.sqrt(1 - alpha)

    start = tangent_noise(jax.random.key(1), point.shape)
    found = samplers.reverse(exact, SAMPLERS[name], start, jax.random.key(2))
    np.testing.assert_allclose(found, point, atol=2e-4)


@pytest.mark.parametrize("name", [pytest.param("ancestral", marks=pytest.mark.slow), "ddim", "dpm"])
@pytest.mark.parametrize(("length", "times"), [(1, 1), (5, 2), (7, 1)])
def test_repeated_stretches_lead_back_and_end_where_they_did(name, length, times):
    """Each step starts where the one before, or the noise after it, has led; the last word is the data's."""
    table = samplers.repeated(SAMPLERS[name], ALPHAS, length, times).table
    once = SAMPLERS[name].table
    assert len(table["t"]) == (1 + times) * len(once["t"])
    np.testing.assert_array_equal(table["s"][:-1], table["t"][1:])
    np.testing.assert_array_equal(np.unique(table["t"]), np.unique(once["t"]))
    returns = np.flatnonzero(table["back"] != 1)
    assert len(returns) == times * -(-len(once["t"]) // length)
    for row in returns:
        reached = once["s"][once["t"] == table["t"][row]][0]
        np.testing.assert_allclose(ALPHAS[reached] * table["back"][row], ALPHAS[table["s"][row]])
        assert name != "dpm" or table["ratio"][row + 1] == 0


@pytest.mark.parametrize("name", ["ddim", "dpm"])
def test_repeating_draws_anew_from_the_same_gaussian(name):
    start = tangent_noise(jax.random.key(1), (2000, 1))
    sampler = samplers.repeated(SAMPLERS[name], ALPHAS, 5, 2)
    drawn = samplers.reverse(of_gaussian(0.5), sampler, start, jax.random.key(2))
    once = samplers.reverse(of_gaussian(0.5), SAMPLERS[name], start, jax.random.key(2))
    assert abs(np.var(np.real(drawn)) / np.var(np.real(once)) - 1) < 0.1
    correlation = np.corrcoef(np.real(drawn)[:, 0], np.real(once)[:, 0])[0, 1]
    assert abs(correlation) < 0.2  # the noise between has made it new


@pytest.mark.parametrize("count", [1, 7, 50, 1000])
def test_ddim_times_go_from_the_end_to_zero(count):
    t, s = samplers.spaced(ALPHAS, count)
    assert t[0] == 1000 and np.all(np.diff(t) < 0) and len(t) == count
    assert s[-1] == 0 and np.all(s[:-1] == t[1:])


@pytest.mark.slow
def test_a_gaussian_is_sampled_with_its_own_variance():
    start = tangent_noise(jax.random.key(1), (20_000, 1))
    for sampler in (samplers.ancestral(ALPHAS), samplers.ddim(ALPHAS, 200), samplers.dpm_solver(ALPHAS, 50)):
        drawn = samplers.reverse(of_gaussian(0.5), sampler, start, jax.random.key(2))
        np.testing.assert_allclose(np.var(np.real(drawn)), 0.25, rtol=0.04)


def test_the_second_order_solver_comes_closer_in_as_many_steps():
    """The flow of a Gaussian has a closed form: Z_0 = s Z_T / √(α_T s² + 1 − α_T)."""
    spread, start = 0.5, jnp.ones((1, 1), jnp.complex64)
    end = spread / np.sqrt(ALPHAS[-1] * spread**2 + 1 - ALPHAS[-1])

    def error(sampler: samplers.Sampler) -> float:
        return abs(samplers.reverse(of_gaussian(spread), sampler, start, jax.random.key(0))[0, 0] - end)

    for count in (25, 50):
        first, second = error(samplers.ddim(ALPHAS, count)), error(samplers.dpm_solver(ALPHAS, count))
        assert 0 < second < first / 2
    assert error(samplers.ddim(ALPHAS, 100)) < error(samplers.ddim(ALPHAS, 25)) / 2


@pytest.mark.parametrize("count", [20, 25, 50])
def test_the_second_order_solver_keeps_unit_variance_where_ddim_loses_it(count):
    """The flow of unit Gaussian data moves nothing: each step of DDIM shrinks, by the cosine of its angle."""
    start = jnp.ones((1, 1), jnp.complex64)
    first, second = (
        abs(samplers.reverse(of_gaussian(1.0), sampler(ALPHAS, count), start, jax.random.key(0))[0, 0]) ** 2
        for sampler in (samplers.ddim, samplers.dpm_solver)
    )
    assert first < 0.94 and abs(second - 1) < 0.02


@pytest.mark.parametrize("name", [pytest.param("ancestral", marks=pytest.mark.slow), "ddim", "dpm"])
def test_a_hook_sees_every_step_and_has_the_last_word(name):
    """It is called with the time that was reached; what it returns goes on; each step's key is its own."""
    point, table = jnp.full((3, 2), 2 - 1j), SAMPLERS[name].table
    calls = []

    def hook(z, s, key):
        jax.debug.callback(
            lambda s, k: calls.append((float(s), tuple(k.tolist()))), s, jax.random.key_data(key)
        )
        return jnp.where(s == 0, point, z)

    start = tangent_noise(jax.random.key(1), (3, 2))
    plain = samplers.reverse(of_gaussian(1.0), SAMPLERS[name], start, jax.random.key(2))
    drawn = samplers.reverse(of_gaussian(1.0), SAMPLERS[name], start, jax.random.key(2), hook)
    np.testing.assert_array_equal(drawn, point)
    assert [s for s, _ in sorted(calls, reverse=True)] == table["s"].tolist()
    assert len({key for _, key in calls}) == len(table["s"])
    assert np.abs(plain - point).min() > 0.1
    same = samplers.reverse(of_gaussian(1.0), SAMPLERS[name], start, jax.random.key(2), lambda z, s, key: z)
    np.testing.assert_array_equal(same, plain)


@pytest.mark.parametrize("sampler", [samplers.ddim, samplers.dpm_solver])
def test_more_steps_than_the_schedule_has_are_refused(sampler):
    with pytest.raises(ValueError, match="ask for 1 to 1000"):
        sampler(ALPHAS, 1001)
