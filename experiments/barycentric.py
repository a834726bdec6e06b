"""The codec that the FL-VAE is compared with: the ablation of the paper's table 1.

flx train experiments/barycentric.py --images.folder FOLDER

Encoder, data and steps are those of experiments/flvae.py. The decoder interpolates invariants of the codes
over each face, and does not know where in the face a point lies.
"""

from dataclasses import replace
from pathlib import Path

from flx.config import read_config

released = read_config(Path(__file__).with_name("flvae.py"))
config = replace(
    released,
    name="barycentric",
    model=replace(released.model, decoder="interpolated", sharpness=1.0, decoder_width=256, decoder_layers=4),
)
