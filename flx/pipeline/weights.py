"""The files of FL-VAEs: where the released ones are, and how an FL-VAE is configured, without JAX."""

import json
from pathlib import Path

from flx.config import FLVAE
from flx.pipeline.tensors import Tensors, load_tensors, one_line

WEIGHTS = Path(__file__).parent.parent / "weights"
RELEASED = WEIGHTS / "flvae.safetensors"
VECTORS = WEIGHTS / "vectors.safetensors"  # codes of vectors alone, which the paper's network needs
BARYCENTRIC = WEIGHTS / "barycentric.safetensors"  # a baseline, whose decoder interpolates invariants


def weights_file(weights: str | Path | None) -> Path:
    """The file that `--weights` means: the released one, the shipped one of vectors alone, or another."""
    if weights is None:
        return RELEASED
    return VECTORS if str(weights) == "vectors" else Path(weights)


def read_weights(path: Path) -> tuple[FLVAE, Tensors]:
    """The configuration and the parameters in a file. Raises ValueError where it is missing or damaged."""
    try:
        text, tensors = load_tensors(path, "flvae")
        return FLVAE(**json.loads(text)), tensors
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{path} holds no FL-VAE weights ({one_line(error)}); train some with "
            "`flx train experiments/flvae.py`, or leave --weights out for the released ones"
        ) from None
