"""The denoiser for codes that have invariant channels: vector fields and invariant fields side by side.

As deep as the paper's network, with the same reach. A convolution is the set of first-order stencils of
`flx.fields.stencils` and, at each vertex, layers in which the two kinds meet: invariants see inner products
of vectors and the embedding; vectors are scaled by invariants. Fields are pairs [V, 2C], as in the stencils.
"""

from collections.abc import Callable
from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Complex, Float

from flx.config import FLDM
from flx.fields import algebra, convolution
from flx.fields.stencils import Stencils, of_rings, stencils
from flx.models.denoiser.unet import UNet, small
from flx.models.layers import PairsDense, RealDense
from flx.types import Pooling

Fields = tuple[Float[Array, "..."], Float[Array, "..."]]  # vectors and invariants, [V, 2C] each


class PairsNorm(nn.Module):
    """Each channel divided by its root mean square over the surface, times a learnt scale."""

    @nn.compact
    def __call__(self, x: Float[Array, "V C2"], masses: Float[Array, "V"]) -> Float[Array, "V C2"]:
        power = jnp.sum(jnp.reshape(masses @ (x * x), (2, -1)), 0)
        scale = self.param("scale", nn.initializers.ones, power.shape)
        return x * jnp.tile(scale * jax.lax.rsqrt(power + 1e-3), 2)


def both(x: Float[Array, "V C2"], y: Float[Array, "V C2"]) -> tuple[Array, Array]:
    """Re and Im of x̄ y: inner product and determinant of each channel's two vectors."""
    (a, b), (c, d) = jnp.split(x, 2, -1), jnp.split(y, 2, -1)
    return a * c + b * d, a * d - b * c


class MixedConv(nn.Module):
    """Norms, stencils, and one layer at each vertex in which vectors and invariants meet."""

    config: FLDM

    @nn.compact
    def __call__(self, fields: Fields, rings: Stencils, embedding: Float[Array, "*V E"]) -> Fields:
        precision, channels = self.config.precision, fields[0].shape[-1] // 2
        x, t = (PairsNorm()(field, rings.masses) for field in fields)
        mean, reflected, gradient, smooth, divergence = stencils(rings, x, t)

        # Sums of products: one product of the concatenation takes twice the time on XLA:CPU.
        products = jnp.concatenate(both(x, PairsDense(channels, precision)(x)), -1)
        seen = [RealDense(channels, precision)(field) for field in (t, smooth, divergence, products)]
        hidden = nn.silu(sum(seen, RealDense(channels)(embedding)))
        t, gate = jnp.split(RealDense(3 * channels, precision)(hidden), [2 * channels], -1)

        around = [PairsDense(channels, precision)(field) for field in (mean, reflected, gradient)]
        q = sum(around, PairsDense(channels, precision)(x)) / 2
        # Gates are the nonlinearity of vectors: a VN nonlinearity too costs time and learns no better.
        return q * jnp.tile(2 * nn.sigmoid(gate), 2), t


class MixedBlock(nn.Module):
    """Fields plus two convolutions of them; the shape of a scan."""

    config: FLDM

    @nn.compact
    def __call__(
        self, fields: Fields, rings: Stencils, embedding: Float[Array, "*V E"]
    ) -> tuple[Fields, None]:
        y = fields
        for _ in range(2):
            y = MixedConv(self.config)(y, rings, embedding)
        # Blocks begin as almost the identity: at full size the loss exploded within 150 steps.
        size = self.param("size", nn.initializers.constant(0.2), (2, fields[0].shape[-1] // 2))
        x, t = (f + jnp.tile(s, 2) * g for f, s, g in zip(fields, size, y, strict=True))
        return (x, t), None


def _complex(pairs: Float[Array, "V C2"]) -> Complex[Array, "V C"]:
    return jax.lax.complex(*jnp.split(pairs, 2, -1))


def _between(step: Callable[[Pooling, Array], Array], pooling: Pooling, fields: Fields) -> Fields:
    """`pool` or `unpool` of both kinds; invariants are not transported."""
    still = pooling._replace(
        transports=jnp.ones_like(pooling.transports), child_transports=jnp.ones_like(pooling.child_transports)
    )
    x, t = step(pooling, _complex(fields[0])), step(still, _complex(fields[1]))
    return algebra.real_pairs(x), algebra.real_pairs(t)


class MixedDenoiser(UNet):
    """The U-Net whose features are vectors and invariants, as the channels of Z are."""

    Block = MixedBlock
    level = staticmethod(of_rings)
    pool = staticmethod(partial(_between, convolution.pool))
    unpool = staticmethod(partial(_between, convolution.unpool))

    def split(self, z: Complex[Array, "V D"]) -> Fields:
        vectors, invariants = jnp.split(z, [self.config.code_channels[0]], -1)
        return algebra.real_pairs(vectors), algebra.real_pairs(invariants)

    def dense(self, features: int, name: str, x: Fields) -> Fields:
        precision = self.config.precision
        vectors = PairsDense(features, precision, name=name)(x[0])
        return vectors, RealDense(2 * features, precision, name=f"{name}_invariants")(x[1])

    def add(self, name: str, x: Fields, d: Complex[Array, "V n"]) -> Fields:
        pairs = algebra.real_pairs(d)
        return x[0] + PairsDense(x[0].shape[-1] // 2, self.config.precision, name=name)(pairs), x[1]

    def merge(self, upper: Fields, x: Fields) -> Fields:
        upper = self.dense(self.config.channels, "merge", upper)
        skipped = self.dense(self.config.channels, "skip", x)
        return skipped[0] + upper[0], skipped[1] + upper[1]

    def head(self, x: Fields) -> Complex[Array, "V D"]:
        vectors, invariants = self.config.code_channels
        precision = self.config.precision
        a = PairsDense(vectors, precision, small, name="head")(x[0])
        b = RealDense(2 * invariants, precision, name="head_invariants")(x[1])
        return jnp.concatenate([_complex(a), _complex(b)], -1)
