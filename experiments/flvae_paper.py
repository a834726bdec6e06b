"""The paper's field-latent VAE.

flx train experiments/flvae_paper.py --images.folder FOLDER

A VN-Transformer of eight layers and 128 channels, eight tangent vectors for each vertex, L1 of each vertex's
own field plus 0.01 KL, 1.5 million steps of about 16 one-rings. Meant for a GPU: on two CPU cores a step
takes seconds.
"""

from flx.config import FLVAE, FLVAEExperiment, Images, Train

config = FLVAEExperiment(
    name="flvae_paper",
    model=FLVAE(),
    images=Images(),
    train=Train(steps=1_500_000, batch=1),  # a patch has 24 one-rings
)
