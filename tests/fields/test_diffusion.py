"""Laws of diffusion: a schedule that falls, and noise of one size."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from flx.fields import diffusion
from flx.fields.algebra import tangent_noise
from flx.fields.diffusion import Scaling, emphasized, latent_scaling

ALPHAS = diffusion.linear_schedule(1000, 1e-4, 2e-2)


def test_schedule_falls_from_one_to_almost_nothing():
    assert ALPHAS[0] == 1 and np.all(np.diff(ALPHAS) < 0)
    np.testing.assert_allclose(ALPHAS[-1], 4.0e-5, rtol=0.02)


@given(alpha=st.floats(0, 1), seed=st.integers(0, 99))
def test_diffusion_keeps_unit_power(alpha, seed):
    a, b = (tangent_noise(jax.random.key(seed + k), (4000,)) for k in (0, 1000))
    power = np.mean(np.abs(diffusion.diffuse(a, b, jnp.float32(alpha))) ** 2)
    np.testing.assert_allclose(power, 2, rtol=0.1)


def test_scaling_is_undone_turns_with_the_frame_and_has_the_size_of_noise():
    rng = np.random.default_rng(0)
    spread = np.array([3, 0.1, 5, 0.2]) + 1j * np.array([3, 0.1, 0.3, 7])
    z = rng.normal(size=(5000, 4)) * spread.real + 1j * rng.normal(size=(5000, 4)) * spread.imag
    z = (z + np.array([0, 0, 9 - 4j, 2j])).astype(np.complex64)
    scaling = latent_scaling(z, invariants=2)
    scaled = scaling.to_diffusion(z)
    np.testing.assert_allclose(scaling.to_latents(scaled), z, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(np.abs(scaled[:, :2]).mean(0), np.sqrt(np.pi / 2), rtol=1e-3)
    for part in (scaled[:, 2:].real, scaled[:, 2:].imag):
        np.testing.assert_allclose(part.mean(0), 0, atol=1e-3)
        np.testing.assert_allclose(part.std(0), 1, rtol=1e-3)

    turn = np.exp(1j * rng.uniform(-np.pi, np.pi, (5000, 1))) ** np.array([1, 1, 0, 0])
    turned = scaling.to_diffusion((z * turn).astype(np.complex64))
    np.testing.assert_allclose(turned, scaled * turn, atol=1e-4)


@given(exponent=st.floats(0, 1), seed=st.integers(0, 99))
def test_emphasis_makes_channels_that_show_larger_and_keeps_the_mean_square(exponent, seed):
    effects = np.random.default_rng(seed).uniform(0.01, 1, (2, 5)).astype(np.float32)
    plain = Scaling(np.zeros(5, np.complex64), np.full(5, 1 + 1j, np.complex64))
    scale = emphasized(plain, effects[0] + 1j * effects[1], exponent, invariants=2).scale
    parts = np.stack([scale.real, scale.imag])
    np.testing.assert_allclose(np.mean(parts**2), 1, rtol=1e-5)
    np.testing.assert_allclose(parts[0, :3], parts[1, :3], rtol=1e-5)  # or frames could not be turned
    invariant, shown = parts[:, 3:].ravel(), effects[:, 3:].ravel()
    ratio = invariant[:, None] / invariant
    np.testing.assert_allclose(ratio, (shown[:, None] / shown) ** exponent, rtol=1e-3)
