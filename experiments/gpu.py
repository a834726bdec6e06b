"""The scanned bowl, or your own mesh, at 30K vertices on one modern GPU, with our network.

  flx train experiments/gpu.py --surface.path PATH/akita_black_bowl.obj
  flx sample runs/gpu --count 4

Its cost is NOT measured: flx has not run on a GPU yet. `flx doctor MESH --config experiments/gpu.py`
estimates memory and disk; its times are those of two CPU cores.
"""

from flx.config import FLDM, FLDMExperiment, Surface, Train

config = FLDMExperiment(
    name="gpu",
    model=FLDM(predicts="velocity"),  # paper: noise; see docs/paper.md
    surface=Surface(path="akita_black_bowl.obj", vertices=30_000, copies=32, up="z"),  # paper: 500 copies
    train=Train(
        steps=20_000,  # paper: 300,000
        batch=4,  # paper: 16
        optimizer="muon",
        learning_rate=1.6e-2,
        final_learning_rate=1e-4,
        warmup=100,
        clip=1.0,
        checkpoint_every=500,
    ),
)
