"""Classifier-free guidance (Ho & Salimans 2022): one network, with its conditions and without them.

No condition is ρ = 0 everywhere, which is none of the labels, since these are one-hot; and a zero vector as
the direction of every vertex.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
from jax import Array
from jaxtyping import Complex, Float, Num


class Condition(NamedTuple):
    """What samples are conditioned on."""

    rho: Float[Array, "V m"] | None = None
    weight: Float[Array, ""] | None = None  # w; None: 1, without an evaluation that has no condition
    direction: Complex[Array, "V n"] | None = None  # d


def guided(
    denoise: Callable[[Array | None, Array | None], Complex[Array, "V D"]], condition: Condition
) -> Complex[Array, "V D"]:
    """(1 − w) ε(∅) + w ε(ρ, d), for noise as a function of ρ and the direction d: at w = 0 unconditional,
    beyond 1 exaggerated."""
    rho, weight, direction = condition
    found = denoise(rho, direction)
    if weight is None:
        return found
    without = denoise(*(None if given is None else 0 * given for given in (rho, direction)))
    return (1 - weight) * without + weight * found


def dropped(key: Array, rho: Num[Array, "V m"], probability: float) -> Num[Array, "V m"]:
    """ρ, or with this probability no condition at any vertex: training learns both."""
    return rho * jax.random.bernoulli(key, 1 - probability)
