"""The paper's field-latent diffusion model, on codes of eight tangent vectors, 30K vertices and 500 copies.

flx train experiments/fldm_paper.py --surface.path YOUR.glb

The released FL-VAE has invariant channels, which the paper's network cannot take: this one uses the shipped
FL-VAE of vectors alone (experiments/flvae_vectors.py). 300,000 steps of 16 copies are meant for GPUs: on two
CPU cores a step takes minutes. In minutes, the same network on a vase:

flx train experiments/demo.py --name vectors --weights vectors --model.filter mlp
"""

from flx.config import FLDM, FLDMExperiment

config = FLDMExperiment(
    name="fldm_paper",
    model=FLDM(network="vectors", filter="mlp", blocks=(2, 4, 4)),
    weights="vectors",
)
