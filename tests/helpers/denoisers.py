"""Small denoisers of vectors on a torus."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
from helpers.frames import field, tables_of
from helpers.surfaces import torus

from flx.config import FLDM
from flx.models.denoiser.vectors import Denoiser

SMALL = FLDM(latents=3, channels=6, vn_layers=1, embedding=8, conditions=2, precision="float32")
FILTERS = ("harmonic", "mlp")
TORUS = tables_of(torus(8, 6))
COUNT = len(TORUS.fine.masses)
RHO = jax.random.normal(jax.random.key(9), (COUNT, 2))


@functools.cache
def denoiser(filter: str, conditions: int = 2):
    """(apply, parameters), compiled once for the whole file."""
    model = Denoiser(dataclasses.replace(SMALL, filter=filter, conditions=conditions), (1, 1, 1))
    rho = RHO if conditions else None
    params = jax.jit(model.init)(jax.random.key(0), TORUS, field(COUNT, 3), jnp.float32(1.0), rho)
    return jax.jit(model.apply), params
