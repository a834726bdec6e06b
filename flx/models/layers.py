"""Layers that the codec and the denoiser share: Flax modules around the equations of `flx.fields.algebra`."""

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Complex, Float

from flx.config import Precision
from flx.fields import algebra


class Posterior(NamedTuple):
    """Isotropic Gaussians in the tangent plane: a vector mean, and one σ for both real coordinates."""

    mean: Complex[Array, "*B D"]
    log_sigma: Float[Array, "*B D"]

    @classmethod
    def starting_small(cls, mean: Complex[Array, "*B D"], log_sigma: Float[Array, "*B D"]) -> "Posterior":
        """Shift log σ by −3: untrained heads give 0, and with σ = 1 noise would drown the first codes."""
        return cls(mean, log_sigma - 3.0)

    def sample(self, key: Array) -> Complex[Array, "*B D"]:
        """z = μ + σ ε (reparameterisation)."""
        return self.mean + jnp.exp(self.log_sigma) * algebra.tangent_noise(key, self.mean.shape)


def complex_initializer(key: Array, shape: tuple[int, ...], dtype: type = jnp.float32) -> Array:
    """Normal (re, im) pairs with E|w|² = 1/fan_in, which preserves the second moment of a vector."""
    return jax.random.normal(key, shape, dtype) / jnp.sqrt(2.0 * shape[-2])


class ComplexDense(nn.Module):
    """A complex linear map without bias; the parameter holds (re, im) pairs [2, C, features]."""

    features: int
    precision: Precision = "float32"
    kernel_init: nn.initializers.Initializer = complex_initializer

    @nn.compact
    def __call__(self, x: Complex[Array, "*V C"]) -> Complex[Array, "*V D"]:
        kernel = self.param("kernel", self.kernel_init, (2, x.shape[-1], self.features))
        return algebra.complex_linear(x, kernel, self.precision)


class PairsDense(ComplexDense):
    """`ComplexDense` on pairs [V, 2C], the real parts before the imaginary ones."""

    @nn.compact
    def __call__(self, x: Float[Array, "*V C2"]) -> Float[Array, "*V D2"]:
        kernel = self.param("kernel", self.kernel_init, (2, x.shape[-1] // 2, self.features))
        return algebra.complex_linear_pairs(x, kernel, self.precision)


class RealDense(nn.Module):
    """A real linear map with bias; `start` scales the initial weights."""

    features: int
    precision: Precision = "float32"
    start: float = 1.0

    @nn.compact
    def __call__(self, x: Float[Array, "*V C"]) -> Float[Array, "*V D"]:
        initializer = nn.initializers.variance_scaling(self.start**2, "fan_in", "truncated_normal")
        kernel = self.param("kernel", initializer, (x.shape[-1], self.features))
        # Not zeros: a black colour, which is zero, must not give a zero feature.
        bias = self.param("bias", nn.initializers.normal(0.1 * self.start), (self.features,))
        return algebra.dense(x, kernel, self.precision) + bias


class RealMLP(nn.Module):
    """Real dense layers with SiLU between them; `start` scales the initial weights of the last."""

    widths: tuple[int, ...]
    precision: Precision = "float32"
    start: float = 1.0

    @nn.compact
    def __call__(self, x: Float[Array, "*V C"]) -> Float[Array, "*V D"]:
        *hidden, last = self.widths
        for width in hidden:
            x = nn.silu(RealDense(width, self.precision)(x))
        return RealDense(last, self.precision, self.start)(x)


class VNLayer(nn.Module):
    """The VN nonlinearity of two complex linear maps Q and K, computed as one matrix product."""

    features: int
    precision: Precision = "float32"
    delta: float = 1e-6  # where |K|² is smaller, the nonlinearity fades

    @nn.compact
    def __call__(self, x: Complex[Array, "*V C"]) -> Complex[Array, "*V D"]:
        q, k = jnp.split(ComplexDense(2 * self.features, self.precision)(x), 2, -1)
        return algebra.vn_nonlinearity(q, k, self.delta)


def unit_scale(_: Array, shape: tuple[int, ...]) -> Array:
    """Initialise to the complex number 1 in every channel, as (re, im) pairs [2, C]."""
    return jnp.stack([jnp.ones(shape[1:]), jnp.zeros(shape[1:])])


class FieldNorm(nn.Module):
    """Filter response normalisation over the surface, with learned a ∈ ℂ and δ > 0 per channel."""

    @nn.compact
    def __call__(self, x: Complex[Array, "V C"], masses: Float[Array, "V"]) -> Complex[Array, "V C"]:
        scale = self.param("scale", unit_scale, (2, x.shape[-1]))
        delta = self.param("delta", nn.initializers.constant(1e-3), (x.shape[-1],))
        return algebra.response_norm(x, masses, scale, jnp.abs(delta) + 1e-6)


class TokenNorm(nn.Module):
    """Normalisation of each token over its own channels, with a learned complex scale."""

    @nn.compact
    def __call__(self, x: Complex[Array, "*V C"]) -> Complex[Array, "*V C"]:
        return algebra.token_norm(x, self.param("scale", unit_scale, (2, x.shape[-1])))


def timestep_features(t: Float[Array, ""], width: int) -> Float[Array, "width"]:
    """Cosines and sines of t at `width`/2 frequencies from 1 to 10⁻⁴ (Vaswani et al. 2017)."""
    half = width // 2
    frequencies = jnp.exp(-jnp.log(1e4) * jnp.arange(half) / (half - 1))
    return jnp.concatenate([jnp.cos(t * frequencies), jnp.sin(t * frequencies)])
