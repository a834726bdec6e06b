"""Law of `flx train`: what cannot be trained is refused before anything is made."""

import pytest

from flx.commands.train import learn
from flx.config import FLVAE, FLVAEExperiment


def test_a_model_that_cannot_be_made_leaves_no_run_behind(tmp_path):
    with pytest.raises(ValueError, match="invariants"):
        learn(FLVAEExperiment(model=FLVAE(encoder="frame")), tmp_path)
    assert not list(tmp_path.iterdir())
