"""Adam or Muon along a warm-up and a cosine."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import Array
from jaxtyping import Float32, Int

from flx.config import Train

MATRICES = ("kernel", "output")  # names of the parameters that Muon updates: of a layer, of a filter bank
ADAM_RATE = 0.15  # share of Muon's learning rate at which Adam updates the other parameters


def learning_rate(config: Train, step: Int[Any, ""] | int) -> Float32[Array, ""]:
    """Linear warm-up from 0 to `learning_rate`, then a cosine to `final_learning_rate` at the last step."""
    peak, final = config.learning_rate, config.final_learning_rate
    warmup = min(config.warmup, config.steps // 2)
    progress = jnp.clip((step - warmup) / max(config.steps - 1 - warmup, 1), 0, 1)
    cosine = final + (peak - final) * (1 + jnp.cos(jnp.pi * progress)) / 2
    warm = jnp.clip(step / max(warmup, 1), 0, 1) if warmup else 1.0
    return jnp.asarray(warm * cosine, jnp.float32)


def make_optimizer(config: Train) -> optax.GradientTransformation:
    """Adam or Muon along `learning_rate`, on gradients no longer than `clip` (0: as they are)."""
    optimizer = {"adam": optax.adam, "muon": muon}[config.optimizer](lambda step: learning_rate(config, step))
    return optax.chain(optax.clip_by_global_norm(config.clip), optimizer) if config.clip else optimizer


def muon(rate: optax.Schedule) -> optax.GradientTransformation:
    """Muon (Jordan et al. 2024): dense kernels get orthogonal updates, so all directions learn alike.

    `rate` is the spectral norm of such an update. Adam updates all other parameters, at a smaller rate.
    """

    dimensions = partial(jax.tree.map_with_path, _kernel_dimensions)
    slower = lambda step: ADAM_RATE * rate(step)  # noqa: E731
    return optax.contrib.muon(rate, adam_learning_rate=slower, muon_weight_dimension_numbers=dimensions)


def _kernel_dimensions(path: tuple, leaf: Any) -> optax.contrib.MuonDimensionNumbers | None:
    """Kernels are [..., inputs, outputs]; layers of a scan and (re, im) are matrices of their own."""
    if getattr(path[-1], "key", None) not in MATRICES:
        return None
    return optax.contrib.MuonDimensionNumbers(reduction_axis=leaf.ndim - 2, output_axis=leaf.ndim - 1)
