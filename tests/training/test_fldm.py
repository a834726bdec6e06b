"""Law of the loss of diffusion: 0 for who knows the noise, 1 for who says nothing."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.surfaces import square_grid

from flx.config import FLDM
from flx.fields.algebra import tangent_noise
from flx.geometry.tables import mesh_tables, stack
from flx.models.denoiser.unet import schedule
from flx.models.denoiser.vectors import Denoiser
from flx.training.fldm import MeshBatch, diffusion_loss


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
    batch = MeshBatch(stack([mesh_tables(square_grid(8))] * 50), jnp.stack([DATA] * 50))
    for says_nothing, expected, close in ((False, 0, 1e-3), (True, 1, 0.05)):
        loss = diffusion_loss(model, Knowing(model, (1, 1, 1), says_nothing))
        found, _ = jax.jit(loss)({}, batch, jax.random.key(0))
        np.testing.assert_allclose(found, expected, atol=close)
