"""Adam or Muon along a warm-up and a cosine."""

import math
from collections import defaultdict
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
    slower = lambda step: ADAM_RATE * rate(step)  # noqa: E731
    matrices = partial(jax.tree.map, lambda a: _MATRICES if a.ndim == 3 else None)
    inner = optax.contrib.muon(rate, adam_learning_rate=slower, muon_weight_dimension_numbers=matrices)

    def update(gradient: Any, state: Any, params: Any = None) -> tuple[Any, Any]:
        stacked = None if params is None else _stacked(params)
        updates, state = inner.update(_stacked(gradient), state, stacked)
        return _unstacked(updates, gradient), state

    return optax.GradientTransformation(lambda params: inner.init(_stacked(params)), update)  # type: ignore[arg-type]


_MATRICES = optax.contrib.MuonDimensionNumbers(reduction_axis=1, output_axis=2)


def _stacked(params: Any) -> dict[str, Float32[Array, "..."]]:
    """All kernels of one shape as one stack [N, inputs, outputs], and the rest as one row.

    Kernels are [..., inputs, outputs]; layers of a scan and (re, im) are matrices of their own. Orthogonal
    updates of a few stacks take a third less time than those of many small matrices, and compile faster.
    """
    paths = jax.tree.leaves_with_path(params)
    kernels, rest = defaultdict(list), []
    for path, leaf in paths:
        if _is_kernel(path):
            kernels[_shape_name(leaf)].append(leaf.reshape(-1, *leaf.shape[-2:]))
        else:
            rest.append(leaf.reshape(-1))
    stacks = {name: jnp.concatenate(parts) for name, parts in kernels.items()}
    return stacks | ({"rest": jnp.concatenate(rest)} if rest else {})


def _unstacked(stacks: Any, like: Any) -> Any:
    """The inverse of `_stacked`, in the shape of `like`."""
    taken = defaultdict(int)

    def take(path: tuple, leaf: Array) -> Array:
        name = _shape_name(leaf) if _is_kernel(path) else "rest"
        count = leaf.size // math.prod(stacks[name].shape[1:])
        first, taken[name] = taken[name], taken[name] + count
        return stacks[name][first : first + count].reshape(leaf.shape)

    return jax.tree.map_with_path(take, like)


def _is_kernel(path: tuple) -> bool:
    return getattr(path[-1], "key", None) in MATRICES


def _shape_name(kernel: Array) -> str:
    return "x".join(map(str, kernel.shape[-2:]))
