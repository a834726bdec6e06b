"""What a training run will take: an estimate, within a factor of two on two CPU cores.

Measured on an AMD EPYC without AMX: `experiments/demo.py` at 5,000 vertices, `experiments/bowl.py` at 10,000,
and `flx bench`.
"""

from typing import NamedTuple

from flx.config import FLDMExperiment
from flx.geometry.copies import COPY_BYTES
from flx.models.denoiser.depth import blocks_for

COPY_SECONDS = 1.6e-4  # per vertex of a copy: remeshing, tables and colours, two copies at a time
# Per vertex, channel, block and copy of a training step, by network.
STEP_SECONDS = {"vectors": 5.0e-7, "mixed": 2.7e-7}
STEP_BYTES = 900  # memory, per the same
BASE_BYTES = 600e6  # memory of JAX and of the mesh
COMPILE_SECONDS = 45.0  # of a training step, 38 to 59 measured; a few, where compiled programs are kept


class Costs(NamedTuple):
    """The size of a run, and what it takes. Plain numbers, for JSON."""

    vertices: int
    copies: int
    steps: int
    batch: int
    copy_seconds: float  # of all copies
    disk_bytes: float
    compile_seconds: float
    step_seconds: float
    train_seconds: float
    train_bytes: float  # of memory


def costs_of(experiment: FLDMExperiment) -> Costs:
    """The estimate for an experiment."""
    surface, train, model = experiment.surface, experiment.train, experiment.model
    blocks = sum(model.blocks or blocks_for(surface.vertices))
    work = float(surface.vertices) * model.channels * blocks * train.batch
    step_seconds = STEP_SECONDS[model.network or "mixed"] * work  # the released FL-VAE needs "mixed"
    return Costs(
        vertices=surface.vertices,
        copies=surface.copies,
        steps=train.steps,
        batch=train.batch,
        copy_seconds=COPY_SECONDS * surface.vertices * surface.copies,
        disk_bytes=float(COPY_BYTES) * surface.vertices * surface.copies,
        compile_seconds=COMPILE_SECONDS,
        step_seconds=step_seconds,
        train_seconds=step_seconds * train.steps,
        train_bytes=BASE_BYTES + STEP_BYTES * work / train.accumulate,
    )
