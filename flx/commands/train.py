"""`flx train`: prepare and train what a config describes."""

from pathlib import Path

from flx.config import Experiment, FLVAEExperiment
from flx.training.run import Run


def learn(experiment: Experiment, root: Path) -> Run:
    """Train what the experiment describes, from where it was left; return its run folder under `root`."""
    if isinstance(experiment, FLVAEExperiment):
        from flx.training.flvae import learn_flvae

        return learn_flvae(experiment, root)
    from flx.training.fldm import learn_fldm

    return learn_fldm(experiment, root)
