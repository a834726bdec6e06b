"""Laws of the scaling between latents and what is diffused, and of the losses."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.surfaces import square_grid

from flx.commands.train import learn
from flx.config import FLDM, FLVAE, FLVAEExperiment
from flx.fields.algebra import tangent_noise
from flx.fields.diffusion import latent_scaling
from flx.geometry.tables import mesh_tables, stack
from flx.models.denoiser.unet import schedule
from flx.models.denoiser.vectors import Denoiser
from flx.pipeline.codec import initial_params
from flx.pipeline.copies import Prepared
from flx.pipeline.patches import PatchBatch
from flx.training.fldm import MeshBatch, diffusion_loss
from flx.training.flvae import image_loss
from flx.types import Queries, RingSamples


def copy_of(latents: np.ndarray) -> Prepared:
    """A copy of which only the latents matter here."""
    sheet = square_grid(4)
    return Prepared(sheet, mesh_tables(sheet), latents)


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


@pytest.mark.parametrize("predicts", ["noise", "velocity"])
def test_the_loss_is_zero_for_who_knows_the_answer_and_one_for_who_says_nothing(predicts):
    model = FLDM(predicts=predicts)
    batch = MeshBatch(stack([mesh_tables(square_grid(8))] * 50), jnp.stack([DATA] * 50))
    for says_nothing, expected, close in ((False, 0, 1e-3), (True, 1, 0.05)):
        loss = diffusion_loss(model, Knowing(model, (1, 1, 1), says_nothing))
        found, _ = jax.jit(loss)({}, batch, jax.random.key(0))
        np.testing.assert_allclose(found, expected, atol=close)


@pytest.fixture(scope="module")
def small() -> tuple:
    """A tiny model and its parameters."""
    model = FLVAE(channels=4, layers=0, heads=1, samples=5, decoder_width=8, decoder_layers=2)
    return model, initial_params(model, 0)


def test_who_learns_the_blend_hears_of_a_corner_what_is_seen_of_it(small):
    """Points at the first corner of their face show nothing of the others."""
    (model, params), rng = small, np.random.default_rng(0)
    rings = RingSamples(tangent_noise(jax.random.key(1), (6, 5)), jnp.ones((6, 5, 3)))
    seen = tangent_noise(jax.random.key(2), (9, 3))
    first = jnp.tile(jnp.eye(3)[0], (9, 1))
    queries = Queries(jnp.asarray(rng.integers(0, 6, (9, 3)), jnp.int32), seen, first)

    @jax.jit
    def losses(logs):
        batch = PatchBatch(rings, queries._replace(logs=logs), jnp.ones((9, 3)))
        both = [FLVAEExperiment(model=model, learns=learns) for learns in ("blend", "corners")]
        return jnp.array([image_loss(each)(params, batch, jax.random.key(0))[0] for each in both])

    of_others = np.abs(losses(seen.at[:, 1:].mul(3.0)) - losses(seen))
    assert of_others[0] < 1e-6 and of_others[1] > 1e-3
    assert np.abs(losses(seen.at[:, 0].mul(3.0)) - losses(seen)).min() > 1e-3


def test_the_weight_of_the_kl_divergence_is_the_experiment_s(small):
    model, params = small
    rings = RingSamples(tangent_noise(jax.random.key(1), (6, 5)), jnp.ones((6, 5, 3)))
    logs = tangent_noise(jax.random.key(2), (9, 3))
    queries = Queries(jnp.zeros((9, 3), jnp.int32), logs, jnp.full((9, 3), 1 / 3))
    asked = (("blend", 0.5), ("corners", 2.0))

    @jax.jit
    def losses(batch):
        each = [FLVAEExperiment(model=model, learns=learns, kl_weight=weight) for learns, weight in asked]
        found = [image_loss(experiment)(params, batch, jax.random.key(0)) for experiment in each]
        return jnp.array([(total, parts["l1"], parts["kl"]) for total, parts in found])

    total, l1, kl = losses(PatchBatch(rings, queries, jnp.ones((9, 3)))).T
    np.testing.assert_allclose(total, l1 + np.array([weight for _, weight in asked]) * kl, rtol=1e-5)
    assert min(kl.min(), l1.min()) > 0.05


def test_a_model_that_cannot_be_made_leaves_no_run_behind(tmp_path):
    with pytest.raises(ValueError, match="invariants"):
        learn(FLVAEExperiment(model=FLVAE(encoder="frame")), tmp_path)
    assert not list(tmp_path.iterdir())
