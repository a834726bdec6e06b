"""The paper's field-latent encoder and decoder (section 3 and supplement B.1)."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Complex, Float

from flx.config import FLVAE, Precision
from flx.fields import algebra
from flx.models.codec.interpolated import products
from flx.models.layers import ComplexDense, Posterior, RealMLP, TokenNorm, VNLayer
from flx.types import RingSamples


class ComplexMLP(nn.Module):
    """A real MLP from invariants to complex coefficients, its outputs read as (re, im)."""

    widths: tuple[int, ...]
    precision: Precision = "float32"

    @nn.compact
    def __call__(self, x: Float[Array, "*B C"]) -> Complex[Array, "*B D"]:
        pairs = RealMLP((*self.widths[:-1], 2 * self.widths[-1]), self.precision)(x)
        return jax.lax.complex(*jnp.split(pairs, 2, -1))


class Attention(nn.Module):
    """Multi-head attention with complex linear maps; its logits Re(q̄ k) do not depend on the frame."""

    heads: int
    precision: Precision = "float32"

    @nn.compact
    def __call__(self, x: Complex[Array, "*B T C"]) -> Complex[Array, "*B T C"]:
        channels = x.shape[-1]
        qkv = jnp.split(ComplexDense(3 * channels, self.precision)(x), 3, -1)
        # Heads of (re, im) pairs, whose real inner products are those of the tangent vectors.
        q, k, v = (algebra.real_pairs(part.reshape(*x.shape[:-1], self.heads, -1)) for part in qkv)
        # Not jax.nn.dot_product_attention, whose softmax is float32 even if everything else is float64.
        logits = jnp.einsum("...qhe,...khe->...hqk", q, k) * (channels // self.heads) ** -0.5
        y = jnp.einsum("...hqk,...khe->...qhe", nn.softmax(logits), v)
        merged = jax.lax.complex(*jnp.split(y, 2, -1)).reshape(x.shape)
        return ComplexDense(channels, self.precision)(merged)


class TransformerLayer(nn.Module):
    """x + attention(norm x), then x + two VN layers of norm x (Assaad et al., VN-Transformer)."""

    heads: int
    precision: Precision = "float32"

    @nn.compact
    def __call__(self, x: Complex[Array, "*B T C"]) -> Complex[Array, "*B T C"]:
        x = x + Attention(self.heads, self.precision)(TokenNorm()(x))
        y = VNLayer(x.shape[-1], self.precision)(TokenNorm()(x))
        return x + VNLayer(x.shape[-1], self.precision)(y)


class Encoder(nn.Module):
    """Sample tokens (colours times logs) and a mean token → VN-Transformer → posterior of the mean token."""

    config: FLVAE

    @nn.compact
    def __call__(self, rings: RingSamples) -> Posterior:
        c = self.config
        # The paper lifts colours with a linear map, which sends black to zero; an MLP with biases does not.
        lifted = ComplexMLP((c.channels, c.channels), c.precision)(rings.colors) * rings.logs[..., None]
        filters = ComplexMLP((c.channels, c.channels), c.precision)(jnp.abs(rings.logs)[..., None])
        gathered = ComplexMLP((c.channels,), c.precision)(rings.colors) * filters * rings.logs[..., None]
        token = jnp.mean(gathered, -2, keepdims=True)
        x = jnp.concatenate([token, lifted], -2)
        for _ in range(c.layers):
            x = TransformerLayer(c.heads, c.precision)(x)
        token = TokenNorm()(x[..., 0, :])
        # The mean is read by a two-layer VN MLP, log σ by an MLP on a learned invariant product.
        mean = ComplexDense(c.latents, c.precision)(VNLayer(c.channels, c.precision)(token))
        product = jnp.conj(token) * ComplexDense(c.channels, c.precision)(token)
        log_sigma = RealMLP((c.channels, c.latents), c.precision)(algebra.real_pairs(product))
        return Posterior.starting_small(mean, log_sigma)


class Decoder(nn.Module):
    """The colour field around a vertex: an MLP on log·z̄ and the upper triangle of z z* (paper, eq. 5)."""

    config: FLVAE

    @nn.nowrap
    def expand(self, z: Complex[Array, "*B D"]) -> tuple[Complex[Array, "*B D"], Float[Array, "*B D2"]]:
        """The code, and its products."""
        return z, products(z)

    @nn.compact
    def __call__(self, expanded: tuple[Array, Array], logs: Complex[Array, "*B"]) -> Float[Array, "*B 3"]:
        c, (z, invariants) = self.config, expanded
        features = [invariants, algebra.real_pairs(logs[..., None] * jnp.conj(z))]
        widths = (c.decoder_width,) * (c.decoder_layers - 1) + (3,)
        return 0.5 + RealMLP(widths, c.precision)(jnp.concatenate(features, -1))
