"""The algebra of tangent vectors: complex numbers in the frames of their own vertices.

Every function commutes with a change of frame, x ↦ e^{iα}x. Weights are real arrays: a complex weight is
stored as its (re, im) pair, because on complex arrays optimisers would step along the conjugate of JAX's
gradient.
"""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Complex, Float

from flx.config import Precision


def tangent_noise(key: Array, shape: tuple[int, ...]) -> Complex[Array, "..."]:
    """ε = ε₁ + iε₂ with ε₁, ε₂ ~ N(0, 1), so that E|ε|² = 2 and E|ε| = √(π/2) (paper, eq. 1)."""
    pair = jax.random.normal(key, (*shape, 2))
    return jax.lax.complex(pair[..., 0], pair[..., 1])


def unit(x: Complex[Array, "*V"], delta: float = 1e-12) -> Complex[Array, "*V"]:
    """x / √(|x|² + δ): the direction as a unit complex number, smooth at zero."""
    return x * jax.lax.rsqrt(squared_modulus(x) + delta)


def squared_modulus(x: Complex[Array, "*V"]) -> Float[Array, "*V"]:
    """|x|², whose gradient at zero is zero (that of |x| is NaN)."""
    return jnp.real(x) ** 2 + jnp.imag(x) ** 2


def inner(x: Complex[Array, "*V"], y: Complex[Array, "*V"]) -> Float[Array, "*V"]:
    """Re(x̄ y): the inner product of two tangent vectors, invariant under a change of frame."""
    return jnp.real(x) * jnp.real(y) + jnp.imag(x) * jnp.imag(y)


def real_pairs(x: Complex[Array, "*V C"]) -> Float[Array, "*V C2"]:
    """Complex channels as real ones: the real parts of all channels, then the imaginary parts."""
    return jnp.concatenate([jnp.real(x), jnp.imag(x)], -1)


def dense(x: Float[Array, "*V C"], weight: Float[Array, "C D"], precision: Precision) -> Float[Array, "*V D"]:
    """x W with inputs in the given precision and float32 sums; float64 inputs stay float64.

    The barriers keep XLA:CPU from splitting the product along a preceding concatenation and from fusing the
    gathers there into each part, which is slow.
    """
    x = jax.lax.optimization_barrier(x)
    if precision == "float32" or x.dtype == jnp.float64:
        y = jnp.dot(x, weight.astype(x.dtype), precision=jax.lax.Precision.HIGHEST)
    else:
        low = jnp.bfloat16
        y = jnp.dot(x.astype(low), weight.astype(low), preferred_element_type=jnp.float32)
    return jax.lax.optimization_barrier(y)


def complex_linear(
    x: Complex[Array, "*V C"], weight: Float[Array, "2 C D"], precision: Precision = "float32"
) -> Complex[Array, "*V D"]:
    """x W, computed as one real matrix product. No bias: a constant vector would not turn with the frame.

    `weight` stacks the real and imaginary parts.
    """
    y_re, y_im = jnp.split(complex_linear_pairs(real_pairs(x), weight, precision), 2, -1)
    return jax.lax.complex(y_re, y_im)


def complex_linear_pairs(
    x: Float[Array, "*V C2"], weight: Float[Array, "2 C D"], precision: Precision = "float32"
) -> Float[Array, "*V D2"]:
    """`complex_linear` on `real_pairs`: (x_re, x_im) [[W_re, W_im], [−W_im, W_re]]."""
    real, imaginary = weight
    return dense(x, jnp.block([[real, imaginary], [-imaginary, real]]), precision)


def vn_nonlinearity(
    q: Complex[Array, "*V C"], k: Complex[Array, "*V C"], delta: float = 1e-6
) -> Complex[Array, "*V C"]:
    """Q + ReLU(−⟨Q, K⟩) / (|K|² + δ) · K: removes the component of Q against K (paper, VN nonlinearity).

    Its slope in K reaches |Q| / (2√δ): a small δ amplifies small changes, rounding too, layer after layer.
    """
    return q + (jax.nn.relu(-inner(q, k)) / (squared_modulus(k) + delta)) * k


def response_norm(
    x: Complex[Array, "V C"], masses: Float[Array, "V"], scale: Float[Array, "2 C"], delta: Float[Array, "C"]
) -> Complex[Array, "V C"]:
    """a X / √(E|X|² + δ) per channel, where E is the mean over the surface (paper, filter response norm).

    `masses` sum to 1 and are 0 at spare vertices; `scale` is a as a (re, im) pair.
    """
    power = jnp.einsum("v,vc->c", masses, squared_modulus(x))
    a = jax.lax.complex(scale[0], scale[1])
    return x * (a * jax.lax.rsqrt(power + delta))


def token_norm(
    x: Complex[Array, "*V C"], scale: Float[Array, "2 C"], delta: float = 1e-6
) -> Complex[Array, "*V C"]:
    """a X / √(E_c|X_c|² + δ), where E_c is the mean over the channels of each token.

    The paper takes the mean over p ∈ M, which in the encoder would make a code depend on the rest of its
    batch. Here each token is normalised alone.
    """
    power = jnp.mean(squared_modulus(x), -1, keepdims=True)
    return x * jax.lax.complex(scale[0], scale[1]) * jax.lax.rsqrt(power + delta)
