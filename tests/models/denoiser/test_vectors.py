"""Laws of the denoiser: equivariance of its blocks and of the whole."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.denoisers import COUNT, FILTERS, RHO, SMALL, TORUS, denoiser
from helpers.frames import field, relative, tables_of, turned
from helpers.surfaces import icosphere

from flx.models.denoiser.mixed import MixedDenoiser
from flx.models.denoiser.vectors import Denoiser, FCResNetBlock


@pytest.mark.slow
@pytest.mark.parametrize("network", [Denoiser, MixedDenoiser])
def test_each_part_has_as_many_blocks_as_asked(network):
    config = dataclasses.replace(SMALL, latents=4, invariants=2 if network is MixedDenoiser else 0)
    model = network(config, (3, 4, 5))
    arguments = jax.random.key(0), TORUS, field(COUNT, 4), jnp.float32(1.0), RHO
    params = jax.eval_shape(model.init, *arguments)["params"]
    for part, count in (("before", 3), ("coarse", 4), ("after", 5)):
        assert {leaf.shape[0] for leaf in jax.tree.leaves(params[part])} == {count}


@pytest.mark.slow
def test_a_block_that_adds_nothing_is_the_identity():
    x, embedding = field(COUNT, 6), jnp.ones(8)
    block = FCResNetBlock(SMALL)
    shapes = jax.eval_shape(block.init, jax.random.key(0), x, TORUS.fine, embedding)
    silent = jax.tree.map(lambda a: jnp.zeros(a.shape), shapes)
    np.testing.assert_array_equal(block.apply(silent, x, TORUS.fine, embedding)[0], x)


@pytest.mark.parametrize("filter", FILTERS)
def test_a_block_turns_with_the_frames(filter):
    alpha = np.random.default_rng(0).uniform(0, 2 * np.pi, COUNT)
    turn = np.exp(1j * alpha)[:, None].astype(np.complex64)
    block = FCResNetBlock(dataclasses.replace(SMALL, filter=filter))
    x, embedding = field(COUNT, 6), jnp.ones(8)
    params = block.init(jax.random.key(0), x, TORUS.fine, embedding)
    before = block.apply(params, x, TORUS.fine, embedding)[0]
    after = block.apply(params, turn * x, turned(TORUS, alpha).fine, embedding)[0]
    assert relative(after, turn * before) < 1e-5
    assert relative(before, x) > 0.05  # the block does something


@pytest.mark.slow
@pytest.mark.parametrize("filter", FILTERS)
def test_the_denoiser_turns_with_the_frames(filter):
    alpha = np.random.default_rng(0).uniform(0, 2 * np.pi, COUNT)
    turn = np.exp(1j * alpha)[:, None].astype(np.complex64)
    apply, params = denoiser(filter)
    z, t = field(COUNT, 3), jnp.float32(300.0)
    expected = turn * apply(params, TORUS, z, t, RHO)
    assert relative(apply(params, turned(TORUS, alpha), turn * z, t, RHO), expected) < 1e-5
    # The check fails where the frames turn and the vectors do not.
    assert relative(apply(params, turned(TORUS, alpha), z, t, RHO), expected) > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("network", [Denoiser, MixedDenoiser])
def test_a_direction_turns_with_the_frames(network):
    """Turned with them it changes nothing; turned alone it does."""
    invariants = 2 if network is MixedDenoiser else 0
    model = network(dataclasses.replace(SMALL, latents=4, invariants=invariants, directions=1), (1, 1, 1))
    alpha = np.random.default_rng(0).uniform(0, 2 * np.pi, COUNT)
    turn = np.exp(1j * alpha)[:, None].astype(np.complex64)
    turns = np.concatenate([np.repeat(turn, 4 - invariants, 1), np.ones((COUNT, invariants))], 1)
    z, t, way = field(COUNT, 4), jnp.float32(300.0), field(COUNT, 1, 7)
    way = way / jnp.abs(way)
    shapes = jax.eval_shape(model.init, jax.random.key(0), TORUS, z, t, RHO, way)
    rng = np.random.default_rng(1)  # drawn, not initialised: that would be compiled as well
    params = jax.tree.map(lambda a: rng.normal(size=a.shape, scale=0.2).astype(a.dtype), shapes)
    apply = jax.jit(model.apply)
    here = apply(params, TORUS, z, t, RHO, way)
    there = apply(params, turned(TORUS, alpha), turns * z, t, RHO, turn * way)
    assert relative(there, turns * here) < 1e-5
    for other in (1j * way, -way, 0 * way):
        assert relative(apply(params, TORUS, z, t, RHO, other), here) > 1e-3


@pytest.mark.slow
def test_the_answer_hangs_on_the_step_and_on_the_conditions():
    apply, params = denoiser("harmonic")
    z = field(COUNT, 3)
    first = apply(params, TORUS, z, jnp.float32(10.0), RHO)
    assert relative(apply(params, TORUS, z, jnp.float32(900.0), RHO), first) > 1e-2
    assert relative(apply(params, TORUS, z, jnp.float32(10.0), -RHO), first) > 1e-2


@pytest.mark.slow
def test_conditions_must_be_those_of_the_model():
    apply, params = denoiser("harmonic")
    with pytest.raises(ValueError, match=r"rho has 0 values a vertex; model.conditions is 2"):
        apply(params, TORUS, field(COUNT, 3), jnp.float32(1.0), None)


@pytest.mark.slow
def test_the_first_answer_is_small_and_not_nothing():
    apply, params = denoiser("harmonic")
    size = jnp.sqrt(jnp.mean(jnp.abs(apply(params, TORUS, field(COUNT, 3), jnp.float32(5.0), RHO)) ** 2))
    assert 1e-3 < size < 0.7


@pytest.mark.slow
def test_conditions_reach_no_further_than_the_network():
    """ρ is a field: far from where it changes, only the norms' means carry the change."""
    tables = tables_of(icosphere(3))
    apply, params = denoiser("harmonic")
    z, rho, t = field(642, 3), jnp.zeros((642, 2)), jnp.float32(10.0)
    change = jnp.abs(apply(params, tables, z, t, rho.at[0].set(3.0)) - apply(params, tables, z, t, rho)).max(
        1
    )
    near = np.asarray(tables.fine.neighbors[0])
    assert change[near].mean() > 20 * jnp.median(change)


@pytest.mark.slow
@pytest.mark.parametrize("filter", FILTERS)
def test_gradients_reach_every_parameter_and_are_finite_at_zero(filter):
    """A field without content has no direction to invent: zero stays zero, and nothing divides by it."""
    apply, params = denoiser(filter)
    target = field(COUNT, 3, seed=4)

    @jax.jit
    def gradient(params, z):
        answer, pull = jax.vjp(lambda params, z: apply(params, TORUS, z, jnp.float32(5.0), RHO), params, z)
        return answer, pull(target)

    _, (to_params, _) = gradient(params, field(COUNT, 3))
    for path, leaf in jax.tree_util.tree_leaves_with_path(to_params):
        assert jnp.all(jnp.isfinite(leaf)) and jnp.any(leaf != 0), jax.tree_util.keystr(path)
    answer, at_zero = gradient(params, jnp.zeros((COUNT, 3), jnp.complex64))
    assert jnp.all(answer == 0)
    assert all(jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(at_zero))
