"""Samplers: from noise back to data, by a denoising function."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Complex, Float64, Int

from flx.fields.algebra import tangent_noise
from flx.fields.diffusion import Denoise


class ReverseStep(NamedTuple):
    """Z_{t−1} = C₁ Z_t + C₂ ε̂ + C₃ ε for each step t of a sampler, first step first."""

    t: Any  # Int [N]
    c1: Any  # Float [N]
    c2: Any
    c3: Any


def ancestral_steps(alphas: Float64[np.ndarray, "T"]) -> ReverseStep:
    """The exact posterior of DDPM, from t = T to 1 (paper, supplement; Ho et al.).

    With a = α_t/α_{t−1}: C₁ = 1/√a, C₂ = −(1−a)/√(a(1−α_t)), C₃ = √((1−α_{t−1})(1−a)/(1−α_t)). The paper
    prints C₂ as a product of two roots; it is their difference, which this is without cancellation.
    C₃ is 0 at t = 1.
    """
    t = np.arange(len(alphas) - 1, 0, -1)
    now, before = alphas[t], alphas[t - 1]
    a = now / before
    return ReverseStep(
        t, 1 / np.sqrt(a), -(1 - a) / np.sqrt(a * (1 - now)), np.sqrt((1 - before) * (1 - a) / (1 - now))
    )


def ddim_steps(alphas: Float64[np.ndarray, "T"], count: int) -> ReverseStep:
    """Deterministic steps between `count` + 1 times (Song et al., η = 0), the last one to t = 0.

    Z_{t'} = √α_{t'} Ẑ + √(1−α_{t'}) ε̂ with Ẑ = (Z_t − √(1−α_t) ε̂)/√α_t.
    Raises ValueError where there are fewer than `count` steps.
    """
    total = len(alphas) - 1
    if not 1 <= count <= total:
        raise ValueError(f"a DDIM sampler of {count} steps; the schedule has {total}: ask for 1 to {total}")
    times = np.rint(np.linspace(total, 0, count + 1)).astype(int)
    t, then = times[:-1], times[1:]
    now, after = alphas[t], alphas[then]
    c1 = np.sqrt(after / now)
    return ReverseStep(t, c1, np.sqrt(1 - after) - c1 * np.sqrt(1 - now), np.zeros(count))


def reverse(
    denoise: Denoise, steps: ReverseStep, z: Complex[Array, "*V D"], key: Array
) -> Complex[Array, "*V D"]:
    """Run a sampler as one scan from Z_T = `z` (tangent noise) to Z_0."""

    def step(z: Array, s: tuple[ReverseStep, Int[Array, ""]]) -> tuple[Array, None]:
        coefficients, n = s
        t, c1, c2, c3 = coefficients
        noise = tangent_noise(jax.random.fold_in(key, n), z.shape).astype(z.dtype)
        return c1 * z + c2 * denoise(z, t) + c3 * noise, None

    real = jnp.real(z).dtype
    table = ReverseStep(*(jnp.asarray(column, real) for column in steps))
    return jax.lax.scan(step, z, (table, jnp.arange(len(steps.t))))[0]
