"""Where the training of a diffusion model begins: at random, or at a prior that many images taught."""

import json
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, NamedTuple, cast

import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict

from flx.config import FLDM, from_json
from flx.pipeline.codec import Codec
from flx.pipeline.tensors import load_tensors, one_line, save_tensors
from flx.pipeline.weights import WEIGHTS

RELEASED = WEIGHTS / "prior.safetensors"
PARTS = ("before", "coarse", "after")  # of the network: stacks of blocks, of any number
FREE = (
    "blocks",
    "conditions",
    "draws",
    "emphasis",
    "label_dropout",
    "precision",
)  # what a prior's network may have otherwise


class Prior(NamedTuple):
    """A network to begin with."""

    model: FLDM
    codec: str  # digest of the FL-VAE whose codes it knows
    params: dict[str, np.ndarray]  # by "/"-separated names


def save_prior(path: Path, model: FLDM, params: Any, codec: Codec, step: int, images: int) -> None:
    """Write a trained network as one file, in half precision."""
    tensors = {name: np.asarray(a, np.float16) for name, a in flatten_dict(params["params"], sep="/").items()}
    record = {"model": asdict(model), "codec": codec.digest()}
    save_tensors(path, tensors, "prior", json.dumps(record), {"steps": str(step), "images": str(images)})


def load_prior(start: str) -> Prior:
    """The released prior, or that of a file. Raises ValueError where the file is missing or damaged."""
    path = RELEASED if start == "released" else Path(start)
    try:
        text, tensors = load_tensors(path, "prior")
        record = json.loads(text)
        return Prior(cast(FLDM, from_json(FLDM, record["model"], "model")), record["codec"], tensors)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"start is {start!r}, and {path} holds no prior ({one_line(error)}); give released, random, or "
            "the prior.safetensors of a run of experiments/prior.py"
        ) from None


def check_start(start: str, model: FLDM, codec: Codec) -> Prior | None:
    """The prior that a training of a complete model begins with; None: it begins at random.

    Raises ValueError where the prior is that of another kind of network, or of another FL-VAE.
    """
    if start == "random":
        return None
    prior = load_prior(start)
    for name in (f.name for f in fields(FLDM) if f.name not in FREE):
        ours, theirs = getattr(model, name), getattr(prior.model, name)
        if ours != theirs:
            raise ValueError(
                f"start is {start!r}, a network whose model.{name} is {theirs}, not {ours}; give both the "
                "same, or begin with --start random"
            )
    if codec.digest() != prior.codec:
        raise ValueError(
            f"start is {start!r}, which knows the codes of another FL-VAE; leave --weights out, or begin "
            "with --start random"
        )
    return prior


def begun(prior: Prior, params: Any) -> Any:
    """Initial parameters, with those of the prior in their places.

    Where a part of the network has another number of blocks, block i of m begins as block ⌊i n/m⌋ of the n
    of the prior. What conditions add to the embedding stays as it was.
    """
    flat = flatten_dict(params["params"], sep="/")
    return {"params": unflatten_dict({name: _begun(name, a, prior) for name, a in flat.items()}, sep="/")}


def _begun(name: str, initial: Any, prior: Prior) -> Any:
    known = jnp.asarray(prior.params[name], initial.dtype)
    if name.split("/")[0] in PARTS:
        known = known[np.arange(len(initial)) * len(known) // max(len(initial), 1)]
    if known.shape != initial.shape:  # of the embedding: rows of the conditions follow those of the step
        known = jnp.concatenate([known, initial[len(known) :]])
    return known
