"""Every experiment file is one that the launcher can begin."""

from pathlib import Path

import jax
import pytest

from flx.config import FLVAEExperiment, read_config
from flx.pipeline.codec import initial_params, load_codec
from flx.training.optimizer import make_optimizer

FILES = sorted((Path(__file__).parent.parent / "experiments").glob("*.py"))


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_an_experiment_names_itself_and_can_be_trained(path):
    experiment = read_config(path)
    assert experiment.name == path.stem
    make_optimizer(experiment.train)
    if isinstance(experiment, FLVAEExperiment):
        jax.eval_shape(lambda: initial_params(experiment.model, 0))


@pytest.mark.parametrize("name", ["flvae", "barycentric"])
def test_released_weights_are_of_the_experiment_of_their_name(name):
    folder = FILES[0].parent
    weights = load_codec(folder.parent / "flx" / "weights" / f"{name}.safetensors")
    assert weights.config == read_config(folder / f"{name}.py").model
