"""Laws of the samplers: the reverse steps are the exact posterior, and find what the denoiser knows."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from flx.fields import diffusion, samplers
from flx.fields.algebra import tangent_noise

ALPHAS = diffusion.linear_schedule(1000, 1e-4, 2e-2)


def test_ancestral_steps_are_the_gaussian_posterior():
    """q(z_{t−1} | z_t, z_0) by completing the square, with z_0 = (z_t − √(1−α_t) ε)/√α_t put in."""
    steps = samplers.ancestral_steps(ALPHAS)
    for k in (0, 1, 500, 998):
        now, before = ALPHAS[steps.t[k]], ALPHAS[steps.t[k] - 1]
        a = now / before
        precision = 1 / (1 - before) + a / (1 - a)
        of_z0, of_zt = np.sqrt(before) / (1 - before) / precision, np.sqrt(a) / (1 - a) / precision
        np.testing.assert_allclose(steps.c1[k], of_zt + of_z0 / np.sqrt(now), rtol=1e-9)
        np.testing.assert_allclose(steps.c2[k], -of_z0 * np.sqrt((1 - now) / now), rtol=1e-9)
        np.testing.assert_allclose(steps.c3[k], np.sqrt(1 / precision), rtol=1e-9)


def test_last_step_adds_no_noise():
    steps = samplers.ancestral_steps(ALPHAS)
    assert steps.t[-1] == 1 and steps.c3[-1] == 0 and steps.c3[0] > 0.1


@pytest.mark.parametrize("steps", [samplers.ancestral_steps(ALPHAS), samplers.ddim_steps(ALPHAS, 20)])
def test_the_exact_denoiser_of_one_point_returns_that_point(steps):
    point = tangent_noise(jax.random.key(0), (7, 3))
    alphas = jnp.asarray(ALPHAS, jnp.float32)

    def exact(z, t):
        alpha = alphas[t.astype(int)]
        return (z - jnp.sqrt(alpha) * point) / jnp.sqrt(1 - alpha)

    start = tangent_noise(jax.random.key(1), point.shape)
    found = samplers.reverse(exact, steps, start, jax.random.key(2))
    np.testing.assert_allclose(found, point, atol=2e-4)


@pytest.mark.parametrize("count", [1, 7, 50, 1000])
def test_ddim_times_go_from_the_end_to_zero(count):
    steps = samplers.ddim_steps(ALPHAS, count)
    assert steps.t[0] == 1000 and np.all(np.diff(steps.t) < 0) and len(steps.t) == count


def test_a_gaussian_is_sampled_with_its_own_variance():
    """For Z ~ N(0, s²) the exact denoiser is linear, and the chain must end with variance s²."""
    spread = 0.5
    alphas = jnp.asarray(ALPHAS, jnp.float32)

    def exact(z, t):
        alpha = alphas[t.astype(int)]
        return z * jnp.sqrt(1 - alpha) / (alpha * spread**2 + 1 - alpha)

    start = tangent_noise(jax.random.key(1), (20_000, 1))
    for steps in (samplers.ancestral_steps(ALPHAS), samplers.ddim_steps(ALPHAS, 200)):
        found = samplers.reverse(exact, steps, start, jax.random.key(2))
        np.testing.assert_allclose(np.var(np.real(found)), spread**2, rtol=0.04)


def test_more_ddim_steps_than_the_schedule_has_are_refused():
    with pytest.raises(ValueError, match="ask for 1 to 1000"):
        samplers.ddim_steps(ALPHAS, 1001)
