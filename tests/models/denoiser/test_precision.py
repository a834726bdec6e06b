"""Laws of whole denoisers in the precision that they run in, before and after some training.

Rounding to bfloat16 moves each product by a thousandth or two. A well-conditioned network then gives almost
the same answer in all frames and numberings; an ill-conditioned one gives another answer.
"""

import functools
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.frames import frames, renumbered, turned
from helpers.surfaces import uneven_sphere

from flx.config import FLDM, Train
from flx.fields.algebra import squared_modulus, tangent_noise
from flx.geometry.tables import mesh_tables, stack
from flx.pipeline.generator import network_of
from flx.training.fldm import MeshBatch, diffusion_loss, draw_times
from flx.training.loop import initial_state, make_step
from flx.training.stacks import unstacked

pytestmark = pytest.mark.slow

BOUNDS = {"bfloat16": 1e-2, "float32": 1e-6}  # for float64 see tests/models/test_float64.py
VECTORS = FLDM(network="vectors", latents=5, channels=8, embedding=16, blocks=(1, 1, 1))
NETWORKS = {
    "harmonic": VECTORS,
    "mlp": replace(VECTORS, filter="mlp"),
    "mixed": replace(VECTORS, network="mixed", invariants=2),
}
SPHERE = uneven_sphere(0, 200)
COUNT = len(SPHERE.vertices)
STEP = 300.0


class Trained(NamedTuple):
    """A network's parameters before and after it learnt one field."""

    config: FLDM
    first: Any
    last: Any
    losses: list[float]


@functools.cache
def trained(name: str, steps: int = 60) -> Trained:
    """With Adam, at the default precision, on a field that is smooth over the surface."""
    config = NETWORKS[name]
    assert config.precision == FLDM().precision == "bfloat16"
    network, tables = network_of(config), mesh_tables(SPHERE)
    z = smooth(tables, config.latents)
    first = jax.jit(network.init)(jax.random.key(0), tables, z, jnp.float32(1))
    train = Train(steps=steps, learning_rate=3e-3)
    state = initial_state(train, first)
    step = jax.jit(make_step(train, diffusion_loss(config, network), first))
    tables, losses = stack([tables]), []
    for n in range(steps):
        state, scalars = step(state, MeshBatch(tables, z[None], draw_times(config, 0, n, 1)))
        losses.append(float(scalars["loss"]))
    return Trained(config, first, unstacked(state.params, first), losses)


def smooth(tables: Any, channels: int) -> jax.Array:
    r = jax.tree.map(jnp.asarray, tables.fine)
    z = tangent_noise(jax.random.key(3), (COUNT, channels))
    for _ in range(3):
        z = jnp.einsum("vk,vkc->vc", r.weights * r.transports, z[r.neighbors])
    return z * jnp.sqrt(2 / jnp.mean(squared_modulus(z), 0))


@functools.cache
def compiled_answer(name: str, precision: str) -> Any:
    """(parameters, tables, z) → ε̂."""
    network = network_of(replace(NETWORKS[name], precision=precision))
    return jax.jit(lambda params, tables, z: network.apply(params, tables, z, jnp.float32(STEP)))


def difference(a: Any, b: Any) -> float:
    """Relative, root mean square."""
    a, b = np.asarray(a), np.asarray(b)
    assert np.abs(b).max() > 1e-3, "a comparison with zero says nothing"
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))


cases = pytest.mark.parametrize(
    ("name", "when"), [(name, when) for name in NETWORKS for when in ("untrained", "trained")]
)


@cases
@pytest.mark.parametrize("precision", BOUNDS)
def test_answers_turn_with_the_frames_and_do_not_mind_the_numbering(name, when, precision):
    learnt = trained(name)
    params: Any = learnt.first if when == "untrained" else learnt.last
    config, alpha, rng = learnt.config, frames(COUNT), np.random.default_rng(2)
    vectors = np.arange(config.latents) < config.code_channels[0]
    turns = np.where(vectors, np.exp(1j * alpha)[:, None], 1)
    z = np.asarray(tangent_noise(jax.random.key(8), (COUNT, config.latents)))
    tables, turned_z = mesh_tables(SPHERE), (z * turns).astype(np.complex64)
    answer = functools.partial(compiled_answer(name, precision), params)
    here = np.asarray(answer(tables, z))

    assert difference(answer(turned(tables, alpha), turned_z), here * turns) < BOUNDS[precision]
    assert difference(answer(tables, turned_z), here * turns) > 0.1

    order = rng.permutation(COUNT)
    again = renumbered(tables, order, rng.permutation(len(tables.coarse.masses)))
    assert difference(answer(again, z[order]), here[order]) < BOUNDS[precision]
    assert difference(answer(tables, z[order]), here[order]) > 0.1


@cases
def test_a_small_change_of_the_input_is_a_small_change_of_the_answer(name, when):
    """Of a thousandth of the input, that is."""
    learnt = trained(name)
    params = learnt.first if when == "untrained" else learnt.last
    z = tangent_noise(jax.random.key(8), (COUNT, learnt.config.latents))
    change = 1e-3 * tangent_noise(jax.random.key(9), z.shape)
    answer = functools.partial(compiled_answer(name, "float32"), params, mesh_tables(SPHERE))
    assert difference(answer(z + change), answer(z)) < 2e-3


@pytest.mark.parametrize("name", NETWORKS)
def test_some_steps_teach_them_something(name):
    """Or the laws after training would say nothing new."""
    losses = trained(name).losses
    assert np.mean(losses[-20:]) < 0.8 * np.mean(losses[:5])
