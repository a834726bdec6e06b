"""Adam or Muon along a warm-up and a cosine."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import Array
from jaxtyping import Float32, Int

from flx.config import Train

ADAM_RATE = 0.15  # share of Muon's learning rate at which Adam updates the other parameters
# Jordan's iteration five times, spelt out, so that optax compiles one of them.
NEWTON_SCHULZ = ((3.4445, -4.7750, 2.0315),) * 5


def learning_rate(config: Train, step: Int[Any, ""] | int) -> Float32[Array, ""]:
    """Linear warm-up from 0 to `learning_rate`, then a cosine to `final_learning_rate` at the last step."""
    peak, final = config.learning_rate, config.final_learning_rate
    warmup = min(config.warmup, config.steps // 2)
    progress = jnp.clip((step - warmup) / max(config.steps - 1 - warmup, 1), 0, 1)
    cosine = final + (peak - final) * (1 + jnp.cos(jnp.pi * progress)) / 2
    warm = jnp.clip(step / max(warmup, 1), 0, 1) if warmup else 1.0
    return jnp.asarray(warm * cosine, jnp.float32)


def make_optimizer(config: Train) -> optax.GradientTransformation:
    """Adam or Muon along `learning_rate`, on gradients no longer than `clip` (0: as they are).

    Parameters and gradients are those of `flx.training.stacks`.
    """
    optimizer = {"adam": optax.adam, "muon": muon}[config.optimizer](partial(learning_rate, config))
    return optax.chain(optax.clip_by_global_norm(config.clip), optimizer) if config.clip else optimizer


def muon(rate: optax.Schedule) -> optax.GradientTransformation:
    """Muon (Jordan et al. 2024): matrices get orthogonal updates, so all directions learn alike.

    `rate` is the spectral norm of such an update. Adam updates all other parameters, at a smaller rate.
    Stacks [N, inputs, outputs] are matrices, rows are not. One update of a few stacks takes a third less time
    than those of many small matrices.
    """
    slower = lambda step: ADAM_RATE * rate(step)  # noqa: E731
    each = optax.contrib.MuonDimensionNumbers(reduction_axis=1, output_axis=2)
    matrices = partial(jax.tree.map, lambda a: each if a.ndim == 3 else None)
    return optax.contrib.muon(
        rate, NEWTON_SCHULZ, adam_learning_rate=slower, muon_weight_dimension_numbers=matrices
    )
