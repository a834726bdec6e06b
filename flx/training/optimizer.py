"""Adam or Muon along a warm-up and a cosine."""

from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import Array
from jaxtyping import Float32, Int

from flx.config import Train

MATRICES = ("kernel", "output")  # names of parameters that Muon takes: of a layer, of a filter bank

ADAM_BESIDE_MUON = 0.15  # of Muon's rate, for parameters that are no matrices


def learning_rate(config: Train, step: Int[Any, ""] | int) -> Float32[Array, ""]:
    """Linear warm-up from 0 to `learning_rate`, then a cosine to `final_learning_rate` at the last step."""
    peak, final = config.learning_rate, config.final_learning_rate
    progress = jnp.clip((step - config.warmup) / max(config.steps - 1 - config.warmup, 1), 0, 1)
    cosine = final + (peak - final) * (1 + jnp.cos(jnp.pi * progress)) / 2
    warm = jnp.clip(step / max(config.warmup, 1), 0, 1) if config.warmup else 1.0
    return jnp.asarray(warm * cosine, jnp.float32)


def make_optimizer(config: Train) -> optax.GradientTransformation:
    """Adam or Muon along `learning_rate`, on gradients no longer than `clip` (0: as they are).

    Raises ValueError where the configuration cannot be trained with.
    """
    for name in ("steps", "batch", "learning_rate", "log_every", "checkpoint_every"):
        if getattr(config, name) <= 0:
            raise ValueError(f"train.{name} is {getattr(config, name)}; make it more than 0")
    if not 0 <= config.warmup < config.steps:
        raise ValueError(f"train.warmup is {config.warmup}; keep it from 0 to train.steps ({config.steps})")
    if not 0 <= config.ema < 1:
        raise ValueError(f"train.ema is {config.ema}; keep it at least 0 and below 1")
    optimizer = {"adam": optax.adam, "muon": muon}[config.optimizer](lambda step: learning_rate(config, step))
    return optax.chain(optax.clip_by_global_norm(config.clip), optimizer) if config.clip else optimizer


def muon(rate: optax.Schedule) -> optax.GradientTransformation:
    """Muon (Jordan et al. 2024): updates of dense kernels made orthogonal: all directions learn alike.

    `rate` is the spectral norm of such an update; what is no kernel is left to Adam, at a smaller rate.
    """

    def dimensions(params: Any) -> Any:
        return jax.tree.map_with_path(_kernel_dimensions, params)

    slower = lambda step: ADAM_BESIDE_MUON * rate(step)  # noqa: E731
    return optax.contrib.muon(rate, adam_learning_rate=slower, muon_weight_dimension_numbers=dimensions)


def _kernel_dimensions(path: tuple, leaf: Any) -> optax.contrib.MuonDimensionNumbers | None:
    """Kernels are [..., inputs, outputs]; layers of a scan and (re, im) are matrices of their own."""
    if getattr(path[-1], "key", None) not in MATRICES:
        return None
    return optax.contrib.MuonDimensionNumbers(reduction_axis=leaf.ndim - 2, output_axis=leaf.ndim - 1)
