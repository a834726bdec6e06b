"""The released prior: a diffusion model that many images taught, where the training on a mesh begins.

flx train experiments/prior.py --images.folder FOLDER

Its network is that of the demo. A piece is a planar mesh of 5,000 vertices on a part of an image of 512²,
2.2 to 4.05 pixels in a mean vertex radius: about as much detail as the demo's vase has in a one-ring. About
an hour on two quiet CPU cores.
"""

from dataclasses import replace

from flx.config import Images, PriorExperiment, Train, quick

config = PriorExperiment(
    model=replace(quick().model, blocks=(1, 1, 2)),
    images=Images(smallest=2.2, largest=4.05),
    train=Train(
        steps=12_000,
        batch=1,
        optimizer="muon",
        learning_rate=1.6e-2,
        final_learning_rate=1e-4,
        warmup=50,
        clip=1.0,
        ema=0.998,
        checkpoint_every=1000,
    ),
)
