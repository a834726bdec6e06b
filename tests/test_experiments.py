"""Every experiment file is one that the launcher can begin."""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from helpers.frames import field, tables_of
from helpers.surfaces import icosphere

from flx.config import FLDM, FLVAE, Experiment, FLVAEExperiment, read_config
from flx.models.denoiser.depth import complete
from flx.pipeline.codec import initial_params, load_codec
from flx.pipeline.generator import network_of
from flx.training.optimizer import make_optimizer

FILES = sorted((Path(__file__).parent.parent / "experiments").glob("*.py"))


def codec_of(weights: str | None) -> FLVAE:
    """A shipped FL-VAE's, or that of the experiment whose run will have made the weights."""
    if weights in (None, "vectors"):
        return load_codec(weights).config
    trained = read_config(FILES[0].parent / f"{Path(weights).parent.name}.py")
    assert isinstance(trained, FLVAEExperiment)
    return trained.model


def parameters_of(experiment: Experiment) -> dict:
    """The shapes of all that the experiment trains; nothing is computed."""
    if isinstance(experiment, FLVAEExperiment):
        return jax.eval_shape(lambda: initial_params(experiment.model, 0))
    codec, tables = codec_of(experiment.weights), tables_of(icosphere(1))
    network = network_of(complete(experiment.model, codec, experiment.surface.vertices))
    z = field(42, codec.latents)
    return jax.eval_shape(network.init, jax.random.key(0), tables, z, jnp.float32(1))


@pytest.mark.slow
@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_an_experiment_names_itself_and_can_be_trained(path):
    experiment = read_config(path)
    assert experiment.name == path.stem
    make_optimizer(experiment.train)
    assert sum(leaf.size for leaf in jax.tree.leaves(parameters_of(experiment))) > 10_000


def test_a_network_that_does_not_fit_its_codec_is_found():
    """The test above would see it: the demo's codec has invariant channels."""
    demo = read_config(FILES[0].parent / "demo.py")
    with pytest.raises(ValueError, match=r"model\.network is 'vectors'"):
        parameters_of(replace(demo, model=replace(demo.model, network="vectors")))


@pytest.mark.parametrize("name", ["flvae", "barycentric"])
def test_released_weights_are_of_the_experiment_of_their_name(name):
    folder = FILES[0].parent
    weights = load_codec(folder.parent / "flx" / "weights" / f"{name}.safetensors")
    assert weights.config == read_config(folder / f"{name}.py").model


@pytest.mark.parametrize(
    ("made", "match"),
    [
        (lambda: FLDM(embedding=2), "model.embedding is 2; give at least 4"),  # 2 and 3 gave NaN
        (lambda: FLDM(embedding=3), "model.embedding is 3; give at least 4"),
        (lambda: FLDM(embedding=9), "model.embedding is 9; make it even"),
        (lambda: FLDM(blocks=(-1, 1, 1_000_000)), "model.blocks is .* 1 to 100"),
        (lambda: FLDM(blocks=(1, 0, 1)), r"model.blocks is \(1, 0, 1\); give three numbers of 1 to 100"),
        (lambda: FLVAE(depth=100_000), "model.depth is 100000; give at most 100"),
        (lambda: FLVAE(width=1 << 30), "model.width is 1073741824; give at most 1,048,576"),
    ],
)
def test_a_network_that_cannot_be_built_is_refused_by_name(made, match):
    with pytest.raises(ValueError, match=match):
        made()
