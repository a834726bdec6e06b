"""The released field-latent VAE.

flx train experiments/flvae.py --images.folder FOLDER

About 22 minutes on one CPU core. PSNR ends between 26 and 27 dB over the training patches, whose scales reach
far beyond what 16 numbers for each vertex can hold, and at 32.8 dB over held-out photographs. It is the frame
codec, not the paper's transformer: see flx/models/codec/frame.py.
"""

from flx.config import FLVAE, FLVAEExperiment, Images, Train

config = FLVAEExperiment(
    name="flvae",
    model=FLVAE(
        encoder="frame",
        invariants=3,  # mean colour and curvature do not turn: as vectors they have no direction to point
        sharpness=2.0,  # paper: barycentric
        precision="float32",
    ),
    kl_weight=1e-4,  # paper: 0.01, which leaves 12 nats a vertex and blurs
    learns="blend",  # paper: each vertex alone
    images=Images(prints=0.2),
    train=Train(
        steps=60_000,
        batch=16,
        learning_rate=1e-3,
        final_learning_rate=1e-5,
        warmup=100,
        clip=1.0,
        ema=0.999,
        checkpoint_every=2000,
    ),
)
