"""A scanned bowl (Google Scanned Objects, Now_Designs_Bowl_Akita_Black) at 10,000 vertices.

flx train experiments/bowl.py --surface.path PATH/akita_black_bowl.obj
flx sample runs/bowl --count 4

On two CPU cores a step takes 0.8 s, and the whole training 40 minutes. The loss, which is 1 for an output of
zero, ends near 0.7.
"""

from flx.config import FLDM, FLDMExperiment, Surface, Train

config = FLDMExperiment(
    name="bowl",
    model=FLDM(network="mixed", channels=48, predicts="velocity", precision="float32"),
    surface=Surface(path="akita_black_bowl.obj", vertices=10_000, copies=8, up="z"),
    train=Train(
        steps=3000,
        batch=1,
        optimizer="muon",
        learning_rate=1.6e-2,
        final_learning_rate=1e-4,
        warmup=50,
        clip=1.0,
        ema=0.995,
        checkpoint_every=100,
    ),
)
