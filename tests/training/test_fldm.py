"""Laws of the loss of diffusion: 0 for who knows the noise, 1 for who says nothing; t drawn evenly."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.surfaces import square_grid
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import kstest

from flx.config import FLDM
from flx.fields.algebra import tangent_noise
from flx.geometry.tables import mesh_tables, stack
from flx.models.denoiser.unet import schedule
from flx.models.denoiser.vectors import Denoiser
from flx.training.fldm import MeshBatch, diffusion_loss, draw_times


class Knowing(Denoiser):
    """Finds what is asked of `DATA` exactly, or says that there is none."""

    says_nothing: bool = False

    @nn.compact
    def __call__(self, tables, z, t, rho=None):
        alpha = jnp.asarray(schedule(FLDM()), jnp.float32)[t.astype(int)]
        noise = (z - jnp.sqrt(alpha) * DATA) / jnp.sqrt(1 - alpha)
        velocity = jnp.sqrt(alpha) * noise - jnp.sqrt(1 - alpha) * DATA
        return (not self.says_nothing) * (noise if self.config.predicts == "noise" else velocity)


DATA = tangent_noise(jax.random.key(3), (64, 8))
DATA = DATA * jnp.sqrt(2 / jnp.mean(jnp.abs(DATA) ** 2))  # exactly as large as noise


@pytest.mark.parametrize("predicts", ["velocity", pytest.param("noise", marks=pytest.mark.slow)])
def test_the_loss_is_zero_for_who_knows_the_answer_and_one_for_who_says_nothing(predicts):
    model = FLDM(predicts=predicts)
    times = draw_times(model, 0, 0, 50)
    batch = MeshBatch(stack([mesh_tables(square_grid(8))] * 50), jnp.stack([DATA] * 50), times)
    for says_nothing, expected, close in ((False, 0, 1e-3), (True, 1, 0.05)):
        loss = diffusion_loss(model, Knowing(model, (1, 1, 1), says_nothing))
        found, _ = jax.jit(loss)({}, batch, jax.random.key(0))
        np.testing.assert_allclose(found, expected, atol=close)


@given(seed=st.integers(0, 99), first=st.integers(0, 10_000))
def test_any_stretch_of_a_training_draws_all_noise_levels(seed, first):
    """Uniform: each tenth of the schedule has its share. Log-normal: so has each tenth of the normal."""
    uniform = draw_times(FLDM(), seed, first, 100)
    assert uniform.min() >= 1 and uniform.max() <= 1000
    shares = np.bincount((uniform - 1) // 100, minlength=10)
    assert shares.min() >= 8 and shares.max() <= 12
    drawn = draw_times(FLDM(draws="lognormal"), seed, first, 100)
    alphas = schedule(FLDM())[drawn]
    deviates = (np.log((1 - alphas) / alphas) / 2 - 0.2) / 1.1
    assert kstest(deviates, "norm").statistic < 0.05
    np.testing.assert_array_equal(drawn[40:], draw_times(FLDM(draws="lognormal"), seed, first + 40, 60))
