"""From file to GLB in about a minute of CPU time, for tests.

flx train experiments/smoke.py --surface.path MESH

Too small and too short for good textures; it shows that everything is connected.
"""

from flx.config import FLDM, FLDMExperiment, Surface, Train

config = FLDMExperiment(
    name="smoke",
    model=FLDM(channels=16, embedding=32, precision="float32"),
    surface=Surface(vertices=800, copies=2),
    train=Train(steps=30, batch=1, ema=0.9, checkpoint_every=10, log_every=10),
)
