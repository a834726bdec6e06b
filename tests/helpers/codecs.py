"""Small FL-VAEs of each kind, a little trained, and random one-rings."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from flx.config import FLVAE
from flx.models.codec import frame
from flx.models.codec.vae import FieldLatentVAE
from flx.models.layers import Posterior
from flx.pipeline.codec import initial_params
from flx.types import Queries, RingSamples

SMALL = FLVAE(channels=16, layers=2, heads=4, samples=24, decoder_width=32, precision="float32")
FRAME = replace(SMALL, encoder="frame", invariants=3, width=32, depth=2, edges=6, sharpness=2.0)
VECTORS = replace(FRAME, invariants=0)  # pairs of scalars turn with the gradient
INTERPOLATED = replace(FRAME, decoder="interpolated", sharpness=1.0)
TINY = FLVAE(channels=4, layers=0, heads=1, samples=5, decoder_width=8, decoder_layers=2)
CONFIGS = [SMALL, FRAME, VECTORS, INTERPOLATED]
each_config = pytest.mark.parametrize(
    "config", CONFIGS, ids=lambda c: f"{c.encoder} {c.decoder} {c.invariants}"
)


def rings(count: int, samples: int = 24, seed: int = 0, noise: float = 0.02) -> RingSamples:
    """Random rings with smooth random colours."""
    rng = np.random.default_rng(seed)
    radius, angle = (
        1.9 * np.sqrt(rng.random((2, count, samples)))[0],
        2 * np.pi * rng.random((count, samples)),
    )
    logs = (radius * np.exp(1j * angle)).astype(np.complex64)
    slopes = rng.normal(0, 0.04, (2, count, 1, 3))
    colors = rng.uniform(0.15, 0.85, (count, 1, 3)) + logs.real[..., None] * slopes[0]
    colors = colors + logs.imag[..., None] * slopes[1] + rng.normal(0, noise, (count, samples, 3))
    return RingSamples(jnp.asarray(logs), jnp.asarray(colors, jnp.float32))


@cache
def trained_a_little(config: FLVAE) -> tuple[FieldLatentVAE, dict]:
    params = initial_params(config, 0)
    if config.encoder == "frame":
        params = frame.start_from_principal_components(params, rings(500, config.samples, 9))
    return FieldLatentVAE(config), params


@cache
def program(model: FieldLatentVAE, method: str) -> Callable[..., Any]:
    """A method of the model as a function of its parameters and arguments."""
    return jax.jit(partial(model.apply, method=method))


def encode(model: FieldLatentVAE, params: dict, r: RingSamples) -> Posterior:
    return program(model, "encode")(params, r)


def alone(logs: jax.Array) -> Queries:
    """Points in faces that have the same vertex at all three corners: [V, P] of each vertex."""
    vertices = jnp.broadcast_to(jnp.arange(logs.shape[0], dtype=jnp.int32)[:, None], logs.shape)
    weights = jnp.full((*logs.shape, 3), 1 / 3, jnp.float32)
    thrice = (jnp.stack([a] * 3, -1) for a in (vertices, logs))
    return Queries(*(a.reshape(-1, 3) for a in (*thrice, weights)))


def decode(model: FieldLatentVAE, params: dict, logs: jax.Array, z: jax.Array) -> jax.Array:
    """The colours [V, P] that each vertex's code shows at its own points."""
    expanded = program(model, "expand")(params, z)
    return program(model, "blend")(params, expanded, alone(logs)).reshape(*logs.shape, 3)


def weights_of(logs: jax.Array) -> np.ndarray:
    """How samples count: a Gaussian about the vertex, a mean vertex radius wide."""
    weights = np.exp(-(np.abs(np.asarray(logs, np.complex128)) ** 2) / 2)
    return weights / weights.sum(-1, keepdims=True)
