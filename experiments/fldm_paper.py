"""The paper's field-latent diffusion model, on codes of eight tangent vectors, 30K vertices and 500 copies.

  flx train experiments/flvae_paper.py --images.folder FOLDER
  flx train experiments/fldm_paper.py --surface.path YOUR.glb

The released FL-VAE has invariant channels, which the paper's network cannot take: an FL-VAE of vectors alone
comes first. 300,000 steps of 16 copies are meant for GPUs: on two CPU cores a step takes minutes.
"""

from flx.config import FLDM, FLDMExperiment

config = FLDMExperiment(
    name="fldm_paper",
    model=FLDM(network="vectors", filter="mlp", blocks=(2, 4, 4)),
    weights="runs/flvae_paper/flvae.safetensors",
)
