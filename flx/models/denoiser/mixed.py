"""The denoiser for codes that have invariant channels: vector fields and invariant fields side by side.

The same two-level U-Net as `denoiser.vectors`, as deep, with the same reach. A convolution is the set of
first-order stencils of `flx.fields.stencils` and, at each vertex, layers in which the two kinds meet:
invariants see inner products of vectors and the embedding, vectors are scaled by invariants.
Inside, fields are pairs [V, 2C] as there.
"""

from collections.abc import Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Complex, Float

from flx.config import FLDM
from flx.fields import algebra
from flx.fields.convolution import pool, unpool
from flx.fields.stencils import stencils
from flx.models.denoiser.depth import Blocks
from flx.models.denoiser.vectors import embed, small
from flx.models.layers import PairsDense, RealDense
from flx.types import MeshTables, OneRings, Pooling

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
    def __call__(self, fields: Fields, rings: OneRings, embedding: Float[Array, "*V E"]) -> Fields:
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
        self, fields: Fields, rings: OneRings, embedding: Float[Array, "*V E"]
    ) -> tuple[Fields, None]:
        y = fields
        for _ in range(2):
            y = MixedConv(self.config)(y, rings, embedding)
        # Blocks begin as almost the identity: at full size the loss exploded within 150 steps.
        size = self.param("size", nn.initializers.constant(0.2), (2, fields[0].shape[-1] // 2))
        x, t = (f + jnp.tile(s, 2) * g for f, s, g in zip(fields, size, y, strict=True))
        return (x, t), None


class MixedDenoiser(nn.Module):
    """ε(Z_t, t, ρ) where the last `config.invariants` channels of Z are invariant; for one mesh copy."""

    config: FLDM
    blocks: Blocks

    @nn.compact
    def __call__(
        self,
        tables: MeshTables,
        z: Complex[Array, "V D"],
        t: Float[Array, ""],
        rho: Float[Array, "V m"] | None = None,
    ) -> Complex[Array, "V D"]:
        """The noise in z at step t. Raises ValueError where ρ is not what `config.conditions` says."""
        c = self.config
        fine, pooling, coarse = tables
        before, middle, after = self.blocks
        embedding = embed(c, t, rho)
        below = embedding if rho is None else embedding[pooling.centers]

        kinds = [algebra.real_pairs(part) for part in jnp.split(z, [c.latents - c.invariants], -1)]
        fields = self._dense(c.channels, "lift", kinds)
        fields = self._run("before", before, fields, fine, embedding)
        lower = self._dense(2 * c.channels, "widen", _between(pool, pooling, fields))
        lower = self._run("coarse", middle, lower, coarse, below)
        upper = self._dense(c.channels, "merge", _between(unpool, pooling, lower))
        fields = self._dense(c.channels, "skip", fields)
        fields = (fields[0] + upper[0], fields[1] + upper[1])
        fields = self._run("after", after, fields, fine, embedding)
        x = PairsDense(c.latents - c.invariants, c.precision, small, name="head")(fields[0])
        y = RealDense(2 * c.invariants, c.precision, name="head_invariants")(fields[1])
        return jnp.concatenate([_complex(x), _complex(y)], -1)

    def _dense(self, features: int, name: str, fields: Sequence[Array]) -> Fields:
        precision = self.config.precision
        x = PairsDense(features, precision, name=name)(fields[0])
        return x, RealDense(2 * features, precision, name=f"{name}_invariants")(fields[1])

    def _run(self, name: str, count: int, fields: Fields, rings: OneRings, embedding: Array) -> Fields:
        """`count` blocks of one shape, scanned over stacked parameters: compiled once."""
        scan = nn.scan(
            MixedBlock,
            variable_axes={"params": 0},
            split_rngs={"params": True},
            in_axes=(nn.broadcast, nn.broadcast),  # pyright: ignore[reportArgumentType]
            length=count,
        )
        return scan(self.config, name=name)(fields, rings, embedding)[0]


def _complex(pairs: Float[Array, "V C2"]) -> Complex[Array, "V C"]:
    return jax.lax.complex(*jnp.split(pairs, 2, -1))


def _between(step, pooling: Pooling, fields: Fields) -> Fields:
    """`pool` or `unpool` of both kinds; invariants are not transported."""
    still = pooling._replace(
        transports=jnp.ones_like(pooling.transports),
        child_transports=jnp.ones_like(pooling.child_transports),
    )
    x, t = step(pooling, _complex(fields[0])), step(still, _complex(fields[1]))
    return algebra.real_pairs(x), algebra.real_pairs(t)
