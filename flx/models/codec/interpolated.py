"""The paper's baseline decoder: an MLP on invariants of the codes, interpolated over the face.

It has no local coordinates: inside a face, its only input is the products z z* of the corners, blended
barycentrically.
"""

import flax.linen as nn
import jax.numpy as jnp
from jax import Array
from jaxtyping import Complex, Float

from flx.config import FLVAE
from flx.fields import algebra
from flx.models.codec.frame import split_code
from flx.models.layers import RealMLP


def products(z: Complex[Array, "*B D"]) -> Float[Array, "*B D2"]:
    """The upper triangle of z z*, invariant under a change of frame, as D² real numbers."""
    i, j = jnp.triu_indices(z.shape[-1], 1)
    return jnp.concatenate(
        [algebra.squared_modulus(z), algebra.real_pairs(z[..., i] * jnp.conj(z[..., j]))], -1
    )


class Decoder(nn.Module):
    """Interpolated invariants → colour."""

    config: FLVAE

    @nn.nowrap
    def expand(self, z: Complex[Array, "*B D"]) -> Float[Array, "*B F"]:
        """The invariant channels and the products of the vectors."""
        scalars, vectors = split_code(z, self.config.invariants)
        return jnp.concatenate([scalars, products(vectors)], -1)

    @nn.compact
    def __call__(self, features: Float[Array, "*B F"]) -> Float[Array, "*B 3"]:
        """The colour at a point with these features."""
        c = self.config
        return 0.5 + RealMLP((c.decoder_width,) * (c.decoder_layers - 1) + (3,), c.precision)(features)
