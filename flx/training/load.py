"""From a path to a generator; where its file is there, neither optimiser nor checkpoints are imported."""

import sys
from pathlib import Path

from flx.arguments import path_of
from flx.config import FLDMExperiment
from flx.pipeline.generator import Generator, read_generator
from flx.training.run import Run, load_config


def load_generator(path: str | Path) -> Generator:
    """The generator in a file, or that of a run folder.

    Args:
        path: A run folder of `flx train`, also while it is training, or a generator.safetensors.

    Raises ValueError where there is none: no run, one that has no checkpoint yet, the run of an FL-VAE, or a
    damaged file.

    Example:
        generator = flx.load_generator("runs/bowl")
        latents = generator.sample(jax.random.key(0))
    """
    path = path_of("path", path, "a run folder of `flx train`, or a generator file")
    if not path.is_dir():
        if not path.exists():
            raise ValueError(f"{path} does not exist; give a run folder of `flx train`, or a generator file")
        return read_generator(path)
    run, experiment = Run(path), load_config(path)
    if not isinstance(experiment, FLDMExperiment):
        raise ValueError(f"{path} is the run of an FL-VAE; sample one of `flx train experiments/demo.py`")
    if run.generator.exists():
        try:
            return read_generator(run.generator)
        except ValueError as fault:
            if not run.checkpoints.exists():
                raise
            print(f"{fault}; it is made again from the newest checkpoint", file=sys.stderr)
    from flx.training.fldm import generator_of_checkpoint

    return generator_of_checkpoint(run, experiment)
