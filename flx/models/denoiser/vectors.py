"""The paper's denoiser: field convolutions of tangent vectors (supplement B.2).

All layers but the embedding are complex-linear or equivariant, so ε turns with the frames of the vertices.
"""

import flax.linen as nn
import jax.numpy as jnp
from jax import Array
from jaxtyping import Complex, Float

from flx.config import FLDM
from flx.fields import convolution
from flx.fields.convolution import field_conv, init_filter
from flx.models.denoiser.unet import UNet, small
from flx.models.layers import ComplexDense, FieldNorm, VNLayer
from flx.types import OneRings

# The paper gives no value for δ of the VN nonlinearity. With 1e-6 and full branches, rounding to bfloat16
# changed the first answer by 95 % at full size; with these, by 0.6 % (docs/paper.md).
DELTA = 1.0  # as large as |K|² is at the start, after a norm
START = 0.2  # of `size`, the factor on a block's branch; as in the mixed network


class FieldConv(nn.Module):
    """The parameters of `flx.fields.convolution.field_conv`."""

    config: FLDM
    features: int

    @nn.compact
    def __call__(
        self,
        rings: OneRings,
        x: Complex[Array, "V C"],
        embedding: Float[Array, "V E"] | Float[Array, "E"] | None = None,
    ) -> Complex[Array, "V D"]:
        c = self.config
        width = 0 if embedding is None else embedding.shape[-1]
        filter = self.param(
            "filter", init_filter, x.shape[-1], self.features, width, c.filter_width, c.filter
        )
        return field_conv(rings, x, filter, embedding, c.filter, c.precision)


class FCResNetBlock(nn.Module):
    """x + size · (VN MLP → field convolution → VN MLP → field convolution that sees the embedding).

    The shape of a scan: the features are what is carried, the rest is the same for every block.
    """

    config: FLDM

    @nn.compact
    def __call__(
        self, x: Complex[Array, "V C"], rings: OneRings, embedding: Float[Array, "V E"] | Float[Array, "E"]
    ) -> tuple[Complex[Array, "V C"], None]:
        channels, y = x.shape[-1], x
        for seen in (None, embedding):
            for _ in range(self.config.vn_layers):
                y = VNLayer(channels, self.config.precision, DELTA)(FieldNorm()(y, rings.masses))
            y = FieldConv(self.config, channels)(rings, y, seen)
        size = self.param("size", nn.initializers.constant(START), (channels,))
        return x + size * y, None


class Denoiser(UNet):
    """The U-Net whose features are tangent vectors, [V, C]."""

    Block = FCResNetBlock
    level = staticmethod(lambda rings: rings)
    pool, unpool = staticmethod(convolution.pool), staticmethod(convolution.unpool)

    def split(self, z: Complex[Array, "V D"]) -> Complex[Array, "V D"]:
        return z

    def dense(self, features: int, name: str, x: Complex[Array, "V C"]) -> Complex[Array, "V D"]:
        return ComplexDense(features, self.config.precision, name=name)(x)

    def add(self, name: str, x: Complex[Array, "V C"], d: Complex[Array, "V n"]) -> Complex[Array, "V C"]:
        return x + self.dense(x.shape[-1], name, d)

    def merge(self, upper: Complex[Array, "V E"], x: Complex[Array, "V C"]) -> Complex[Array, "V C"]:
        return self.dense(self.config.channels, "merge", jnp.concatenate([upper, x], -1))

    def head(self, x: Complex[Array, "V C"]) -> Complex[Array, "V D"]:
        return ComplexDense(self.config.code_channels[0], self.config.precision, small, name="head")(x)
