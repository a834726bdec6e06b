"""The shipped FL-VAE whose codes are eight tangent vectors and nothing else: what the paper's network needs.

flx train experiments/flvae_vectors.py --images.folder FOLDER

The frame codec, with the data and steps of experiments/flvae.py. What does not turn (mean colour, curvature)
becomes vectors along the gradient of the luminance.
"""

from dataclasses import replace
from pathlib import Path

from flx.config import read_config

released = read_config(Path(__file__).with_name("flvae.py"))
config = replace(released, name="flvae_vectors", model=replace(released.model, invariants=0))
