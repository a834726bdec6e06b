"""What the FL-VAE is compared with: `flx train experiments/barycentric.py --images.folder FOLDER`.

Encoder, data and steps of experiments/flvae.py; the decoder interpolates invariants of the codes over each
face and knows no place in it (the ablation of the paper's table 1).
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
