"""Denoising diffusion of tangent vector fields (paper, section 4): schedule, noise, scaling.

α_t is the cumulative share of the signal, α_0 = 1 ≥ … ≥ α_T > 0: Z_t = √α_t Z + √(1−α_t) ε. Each real
coordinate of ε has variance 1, so everything below is the usual DDPM on (re, im) pairs. The schedule is
computed once, in NumPy float64; values indexed inside a scan are float32.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Complex, Complex64, Float, Float64
from scipy.special import ndtri

Denoise = Callable[[Complex[Array, "V D"], Float[Array, ""]], Complex[Array, "V D"]]  # Z_t, t → ε


def linear_schedule(steps: int, beta_start: float, beta_end: float) -> Float64[np.ndarray, "T"]:
    """α_0 … α_T, T + 1 numbers, where 1 − α_t/α_{t−1} grows linearly.

    The paper states α_T = 0, which would make C₁ infinite; its 1,000 steps from 1e-4 to 0.02 end at 4e-5.
    """
    return np.concatenate([[1.0], np.cumprod(1 - np.linspace(beta_start, beta_end, steps))])


def even_numbers(seed: int, first: int, count: int) -> Float64[np.ndarray, "N"]:
    """Numbers first, first + 1, … of a sequence in [0, 1): any stretch of it is spread evenly.

    The additive recurrence with the golden ratio; `seed` chooses where it starts.
    """
    start = np.random.default_rng(seed).random()
    return (start + (first + np.arange(count)) * (np.sqrt(5) - 1) / 2) % 1


def lognormal_steps(
    alphas: Float64[np.ndarray, "T"],
    numbers: Float64[np.ndarray, "N"],
    center: float = 0.2,
    spread: float = 1.1,
) -> Float64[np.ndarray, "N"]:
    """Steps t, as shares of T, at which σ = √((1−α)/α) is log-normal, for uniform numbers in (0, 1).

    `center` and `spread` are the mean and the deviation of ln σ (Karras et al. 2022, table 1, with another
    mean: there is more to decide at high noise where nothing but one texture is learnt).
    """
    log_sigma = np.log((1 - alphas[1:]) / alphas[1:]) / 2
    wanted = center + spread * ndtri(np.clip(numbers, 1e-6, 1 - 1e-6))
    return np.interp(wanted, log_sigma, np.arange(len(log_sigma))) / len(log_sigma)


def diffuse(
    z: Complex[Array, "*B"], noise: Complex[Array, "*B"], alpha: Float[Array, ""]
) -> Complex[Array, "*B"]:
    """Z_t = √α_t Z + √(1−α_t) ε (paper, eq. 8)."""
    return jnp.sqrt(alpha) * z + jnp.sqrt(1 - alpha) * noise


class Scaling(NamedTuple):
    """The affine map from latents to values as large as the noise, with zero mean in invariant channels.

    A vector channel has one scale for both coordinates, and no shift, because no mean is the same in all
    frames. In an invariant channel, both numbers have a scale and a shift of their own.
    """

    shift: Complex64[np.ndarray, "D"]
    scale: Complex64[np.ndarray, "D"]  # the scale of the real part, then that of the imaginary part

    def to_diffusion(self, latents: Complex64[np.ndarray, "V D"]) -> Complex64[np.ndarray, "V D"]:
        """Scaled latents."""
        z = latents - self.shift
        return np.real(z) * np.real(self.scale) + 1j * (np.imag(z) * np.imag(self.scale))

    def to_latents(self, z: Complex64[np.ndarray, "V D"]) -> Complex64[np.ndarray, "V D"]:
        """The inverse."""
        return np.real(z) / np.real(self.scale) + 1j * (np.imag(z) / np.imag(self.scale)) + self.shift


def latent_scaling(latents: Complex64[np.ndarray, "N D"], invariants: int) -> Scaling:
    """√(π/2) / E|Z_i| for vectors (paper, "Scaling input latents"); mean 0, variance 1 for invariants.

    `latents` are those of all vertices of all copies; the last `invariants` channels are invariant.
    """
    vectors, rest = np.split(latents, [latents.shape[1] - invariants], axis=1)
    of_vectors = np.sqrt(np.pi / 2) / np.maximum(np.abs(vectors).mean(0), 1e-6)
    of_rest = 1 / np.maximum(np.real(rest).std(0), 1e-6) + 1j / np.maximum(np.imag(rest).std(0), 1e-6)
    shift = np.concatenate([np.zeros(vectors.shape[1]), rest.mean(0)])
    scale = np.concatenate([of_vectors * (1 + 1j), of_rest])
    return Scaling(shift.astype(np.complex64), scale.astype(np.complex64))


def emphasized(
    scaling: Scaling, effects: Complex64[np.ndarray, "D"], exponent: float, invariants: int
) -> Scaling:
    """A scaling that makes channels larger, the more they show; the mean square of all stays as it was.

    `effects`: what one unit of each channel's real part, and of its imaginary part, does to colours.
    With noise of one size in all channels, those that show most are then decided first, at higher noise.
    """
    sizes = np.stack([np.real(effects), np.imag(effects)])
    vectors = sizes.shape[1] - invariants
    sizes[:, :vectors] = np.sqrt(np.mean(sizes[:, :vectors] ** 2, 0))  # one scale for both coordinates
    factors = sizes**exponent
    factors /= np.sqrt(np.mean(factors**2))
    scale = np.real(scaling.scale) * factors[0] + 1j * np.imag(scaling.scale) * factors[1]
    return Scaling(scaling.shift, scale.astype(np.complex64))
