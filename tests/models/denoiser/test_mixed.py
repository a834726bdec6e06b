"""Laws of the denoiser of vector and invariant fields side by side."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.frames import as_complex, fields, frames, relative, tables_of, turn_of, turned
from helpers.surfaces import icosphere, torus

from flx.config import FLDM
from flx.fields.algebra import real_pairs, tangent_noise
from flx.fields.stencils import of_rings
from flx.models.denoiser.mixed import MixedBlock, MixedDenoiser
from flx.models.denoiser.unet import denoise

pytestmark = pytest.mark.slow

CONFIG = FLDM(
    network="mixed", latents=4, invariants=2, channels=6, embedding=16, conditions=2, precision="float32"
)
TABLES = tables_of(icosphere(2))
COUNT = len(TABLES.fine.masses)
Z = tangent_noise(jax.random.key(0), (COUNT, 4))
RHO = jax.random.normal(jax.random.key(9), (COUNT, 2))


@functools.cache
def denoiser():
    """(network, parameters, ε̂ as a function of parameters, tables, z, t, ρ), compiled once for both laws."""
    network = MixedDenoiser(CONFIG, (1, 1, 2))
    params = jax.jit(network.init)(jax.random.key(2), TABLES, Z, jnp.float32(30), RHO)
    return network, params, jax.jit(functools.partial(denoise, network))


def test_a_block_turns_with_the_frames():
    tables = TABLES
    x, t = fields(len(tables.fine.masses))
    alpha = frames(len(x))
    block = MixedBlock(CONFIG)
    start = (real_pairs(x), real_pairs(t))
    params = jax.jit(block.init)(jax.random.key(2), start, of_rings(tables.fine), jnp.ones(16))
    apply = jax.jit(block.apply)

    def run(x: jax.Array, rings) -> list[jax.Array]:
        pairs, _ = apply(params, (real_pairs(x), start[1]), of_rings(rings), jnp.ones(16))  # type: ignore
        return [as_complex(f) for f in pairs]

    here, still = run(x, tables.fine)
    there, again = run(x * turn_of(alpha), turned(tables, alpha).fine)
    assert relative(there, here * turn_of(alpha)) < 1e-5 and relative(again, still) < 1e-5
    assert relative(here, x) > 0.05 and relative(still, t) > 0.05


def test_a_block_that_adds_nothing_is_the_identity():
    rings = of_rings(tables_of(torus(8, 6)).fine)
    start = tuple(real_pairs(f) for f in fields(48))
    block = MixedBlock(CONFIG)
    shapes = jax.eval_shape(block.init, jax.random.key(2), start, rings, jnp.ones(16))
    silent = jax.tree.map(lambda a: jnp.zeros(a.shape), shapes)
    for a, b in zip(block.apply(silent, start, rings, jnp.ones(16))[0], start, strict=True):  # type: ignore
        np.testing.assert_array_equal(a, b)


def test_the_denoiser_turns_its_vectors_and_not_its_invariants():
    _, params, answer = denoiser()
    alpha = frames(COUNT)
    turn = jnp.concatenate([turn_of(alpha)] * 2 + [jnp.ones((COUNT, 2))], 1)
    here = answer(params, TABLES, Z, jnp.float32(30), RHO)
    there = answer(params, turned(TABLES, alpha), Z * turn, jnp.float32(30), RHO)
    assert relative(there, here * turn) < 1e-5 and np.abs(here).max() > 1e-3
    assert relative(answer(params, TABLES, Z, jnp.float32(900), RHO), here) > 1e-3


def test_the_denoiser_takes_conditions():
    network, params, answer = denoiser()
    t = jnp.float32(30)
    assert relative(answer(params, TABLES, Z, t, RHO + 1), answer(params, TABLES, Z, t, RHO)) > 1e-3
    with pytest.raises(ValueError, match="make them equal"):
        denoise(network, params, TABLES, Z, t)
    with pytest.raises(ValueError, match=r"direction has 1 vectors a vertex; model.directions is 0: make"):
        denoise(network, params, TABLES, Z, t, RHO, Z[:, :1])
