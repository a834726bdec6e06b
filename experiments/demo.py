"""A vase that flx paints itself, learnt at 5,000 vertices in about 11 minutes on two CPU cores.

flx train experiments/demo.py && flx sample runs/demo --count 4
flx train YOUR.glb                                                 the same settings on your own mesh

The loss, which is 1 for an output of zero, ends near 0.7.
"""

from flx.config import FLDM, FLDMExperiment, Surface, Train

config = FLDMExperiment(
    name="demo",
    model=FLDM(
        network="mixed",  # the released codes have invariant channels
        predicts="velocity",  # this and Muon: README, "Where we depart from it"
        channels=48,  # paper: 96; what two cores can train in minutes
        precision="float32",  # bfloat16 is faster only where the CPU has AMX
    ),
    surface=Surface(vertices=5000, copies=8),
    train=Train(
        steps=2400,
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
