"""Laws of the loss of the FL-VAE."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.codecs import TINY

from flx.config import FLVAEExperiment
from flx.fields.algebra import tangent_noise
from flx.pipeline.codec import initial_params
from flx.pipeline.patches import PatchBatch
from flx.training.flvae import image_loss
from flx.types import Queries, RingSamples


@pytest.fixture(scope="module")
def small() -> tuple:
    """A tiny model and random parameters; to initialise it takes long."""
    rng, shapes = np.random.default_rng(0), jax.eval_shape(lambda: initial_params(TINY, 0))
    draw = lambda leaf: jnp.asarray(rng.normal(size=leaf.shape) / np.sqrt(leaf.shape[0]), leaf.dtype)  # noqa: E731
    return TINY, jax.tree.map(draw, shapes)


@pytest.mark.slow
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
