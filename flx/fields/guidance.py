"""Classifier-free guidance (Ho & Salimans 2022): one network, with its conditions and without them.

No condition is ρ = 0 everywhere, which is none of the labels, since these are one-hot.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
from jax import Array
from jaxtyping import Complex, Float


class Condition(NamedTuple):
    """What samples are conditioned on."""

    rho: Float[Array, "V m"]
    weight: Float[Array, ""] | None = None  # w; None: 1, without an evaluation that has no condition


def guided(
    denoise: Callable[[Float[Array, "V m"]], Complex[Array, "V D"]], condition: Condition
) -> Complex[Array, "V D"]:
    """(1 − w) ε(∅) + w ε(ρ), for noise as a function of ρ: at w = 0 unconditional, beyond 1 exaggerated."""
    found = denoise(condition.rho)
    if condition.weight is None:
        return found
    return (1 - condition.weight) * denoise(0 * condition.rho) + condition.weight * found


def dropped(key: Array, rho: Float[Array, "V m"], probability: float) -> Float[Array, "V m"]:
    """ρ, or with this probability no condition at any vertex: training learns both."""
    return rho * jax.random.bernoulli(key, 1 - probability)
