"""Laws of beginning with a prior."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.frames import tables_of
from helpers.surfaces import icosphere

from flx.config import FLDM
from flx.fields.algebra import tangent_noise
from flx.models.denoiser.unet import denoise
from flx.pipeline.codec import load_codec
from flx.pipeline.generator import network_of
from flx.training.start import begun, check_start, load_prior, save_prior

MODEL = FLDM(
    network="mixed", latents=4, invariants=2, channels=6, embedding=16, precision="float32", blocks=(1, 2, 1)
)
TABLES = tables_of(icosphere(1))
Z = tangent_noise(jax.random.key(0), (42, 4))


def initial(model: FLDM, seed: int):
    """Random parameters; drawn here, because the network's own take seconds to compile."""
    rho, rng = jnp.zeros((42, model.conditions)) if model.conditions else None, np.random.default_rng(seed)
    shapes = jax.eval_shape(network_of(model).init, jax.random.key(0), TABLES, Z, jnp.float32(1), rho)
    return jax.tree.map(lambda a: jnp.asarray(rng.normal(size=a.shape) / 4, jnp.float32), shapes)


@pytest.fixture(scope="module")
def known(tmp_path_factory):
    """The file of a network, and its parameters as the file holds them, in half precision."""
    path = tmp_path_factory.mktemp("prior") / "prior.safetensors"
    params = jax.tree.map(lambda a: a.astype(jnp.float16).astype(a.dtype), initial(MODEL, 1))
    save_prior(path, MODEL, params, load_codec(), step=3, images=2)
    return path, params


def test_a_network_of_the_same_depth_begins_as_the_prior(known):
    path, params = known
    params_begun = begun(load_prior(str(path)), initial(MODEL, 2))
    jax.tree.map(np.testing.assert_array_equal, params_begun, params)


@pytest.mark.parametrize(("blocks", "source"), [(4, [0, 0, 1, 1]), (3, [0, 0, 1]), (1, [0]), (0, [])])
def test_blocks_of_another_number_begin_as_those_of_the_same_depth(known, blocks, source):
    path, params = known
    deeper = replace(MODEL, blocks=(1, blocks, 1))
    started = begun(load_prior(str(path)), initial(deeper, 2))["params"]
    if blocks:
        expected = jax.tree.map(lambda a: a[np.array(source)], params["params"]["coarse"])
        jax.tree.map(np.testing.assert_array_equal, started["coarse"], expected)
    jax.tree.map(np.testing.assert_array_equal, started["after"], params["params"]["after"])


@pytest.mark.slow
def test_without_conditions_a_conditioned_network_begins_as_the_prior(known):
    path, params = known
    conditioned = replace(MODEL, conditions=3)
    started = begun(load_prior(str(path)), initial(conditioned, 2))
    t, rho = jnp.float32(30), jnp.zeros((42, 3))
    expected = denoise(network_of(MODEL), params, TABLES, Z, t)
    ours = denoise(network_of(conditioned), started, TABLES, Z, t, rho)
    np.testing.assert_allclose(ours, expected, atol=1e-5)
    others = denoise(network_of(conditioned), started, TABLES, Z, t, rho + 1)
    assert np.abs(others - expected).max() > 1e-4  # conditions are seen from the first step on


def test_a_prior_of_another_kind_is_refused(known):
    path, _ = known
    codec = load_codec()
    assert check_start("random", MODEL, codec) is None
    assert check_start(str(path), replace(MODEL, blocks=(2, 2, 2), conditions=1), codec)
    with pytest.raises(ValueError, match=r"model.channels is 6, not 8.*--start random"):
        check_start(str(path), replace(MODEL, channels=8), codec)
    other = codec._replace(params=jax.tree.map(lambda a: a + 1, codec.params))
    with pytest.raises(ValueError, match="another FL-VAE; leave --weights out"):
        check_start(str(path), MODEL, other)


def test_a_missing_or_damaged_prior_is_one_line(known, tmp_path):
    path, _ = known
    damaged = tmp_path / "prior.safetensors"
    content = bytearray(path.read_bytes())
    content[-5] ^= 1
    damaged.write_bytes(bytes(content))
    for file in (damaged, tmp_path / "none.safetensors", tmp_path):
        with pytest.raises(ValueError, match=r"holds no prior .* experiments/prior.py") as fault:
            load_prior(str(file))
        assert "\n" not in str(fault.value)
