"""The denoiser ε(Z_t, t, ρ): a two-level U-Net of field convolutions on the tables of one mesh.

How much of the surface the network sees is the design: few rings, so that it learns what textures are made
of and not the one texture (paper, "Denoising network"). `blocks_for` chooses the depth, `reach` measures it.
All layers but the embedding are complex-linear or equivariant, so ε turns with the frames of the vertices.
"""

from typing import Any

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Complex, Float, Float64

from flx.config import FLDM
from flx.fields import diffusion
from flx.fields.convolution import field_conv, init_filter, pool, unpool
from flx.models.denoiser.depth import Blocks
from flx.models.layers import (
    ComplexDense,
    FieldNorm,
    RealMLP,
    VNLayer,
    complex_initializer,
    timestep_features,
)
from flx.types import MeshTables, OneRings


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
    """x + (VN MLP → field convolution → VN MLP → field convolution that sees the embedding).

    The shape of a scan: the features are what is carried, the rest is the same for every block.
    """

    config: FLDM

    @nn.compact
    def __call__(
        self,
        x: Complex[Array, "V C"],
        rings: OneRings,
        embedding: Float[Array, "V E"] | Float[Array, "E"],
    ) -> tuple[Complex[Array, "V C"], None]:
        channels, y = x.shape[-1], x
        for seen in (None, embedding):
            for _ in range(self.config.vn_layers):
                y = VNLayer(channels, self.config.precision)(FieldNorm()(y, rings.masses))
            y = FieldConv(self.config, channels)(rings, y, seen)
        return x + y, None


class Denoiser(nn.Module):
    """ε(Z_t, t, ρ) for one mesh copy; `vmap` it over copies. `blocks` from `blocks_for`."""

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
        """The noise in z at step t, conditioned on the scalars ρ of each vertex, where the model has them.

        Raises ValueError where ρ is not what `config.conditions` says.
        """
        c = self.config
        fine, pooling, coarse = tables
        before, middle, after = self.blocks

        embedding = embed(c, t, rho)
        below = embedding if rho is None else embedding[pooling.centers]

        x = self._dense(c.channels, "lift")(z)
        x = self._run("before", before, x, fine, embedding)
        y = self._dense(2 * c.channels, "widen")(pool(pooling, x))
        y = self._run("coarse", middle, y, coarse, below)
        x = self._dense(c.channels, "merge")(jnp.concatenate([unpool(pooling, y), x], -1))
        x = self._run("after", after, x, fine, embedding)
        # A small first answer: the loss starts at that of predicting zero, E|ε|² = 2.
        return ComplexDense(c.latents, c.precision, small, name="head")(x)

    def _dense(self, features: int, name: str) -> ComplexDense:
        return ComplexDense(features, self.config.precision, name=name)

    def _run(self, name: str, count: int, x: Array, rings: OneRings, embedding: Array) -> Array:
        """`count` blocks of one shape, scanned over stacked parameters: compiled once."""
        scan = nn.scan(
            FCResNetBlock,
            variable_axes={"params": 0},
            split_rngs={"params": True},
            in_axes=(nn.broadcast, nn.broadcast),  # pyright: ignore[reportArgumentType]
            length=count,
        )
        return scan(self.config, name=name)(x, rings, embedding)[0]


def embed(
    config: FLDM, t: Float[Array, ""], rho: Float[Array, "V m"] | None
) -> Float[Array, "E"] | Float[Array, "V E"]:
    """π: the step and the conditions through a small MLP. For use inside a module's `__call__`.

    Raises ValueError where ρ is not what `config.conditions` says.
    """
    given = 0 if rho is None else rho.shape[-1]
    if given != config.conditions:
        raise ValueError(
            f"rho has {given} values a vertex; model.conditions is {config.conditions}: make them equal"
        )
    embedding = timestep_features(t, config.embedding)
    if rho is not None:
        embedding = jnp.broadcast_to(embedding, (rho.shape[0], config.embedding))
        embedding = jnp.concatenate([embedding, rho], -1)
    widths = (config.embedding, config.embedding)
    return nn.silu(RealMLP(widths, config.precision, name="embedding")(embedding))


def denoise(
    network: nn.Module,
    params: Any,
    tables: MeshTables,
    z: Complex[Array, "V D"],
    t: Float[Array, ""],
    rho: Float[Array, "V m"] | None = None,
) -> Complex[Array, "V D"]:
    """The noise in z = Z_t, by the network as a function of its parameters.

    It answers with ε, or with v = √α_t ε − √(1−α_t) Z (Salimans & Ho 2022): ε = √(1−α_t) Z_t + √α_t v.
    """
    answer = network.apply(params, tables, z, t, rho)
    if network.config.predicts == "noise":  # type: ignore
        return answer  # type: ignore
    alpha = jnp.asarray(schedule(network.config), jnp.float32)[t.astype(jnp.int32)]  # type: ignore
    return jnp.sqrt(1 - alpha) * z + jnp.sqrt(alpha) * answer  # type: ignore


def schedule(config: FLDM) -> Float64[np.ndarray, "T"]:
    """α_0 … α_T."""
    return diffusion.linear_schedule(config.steps, config.beta_start, config.beta_end)


def small(key: Array, shape: tuple[int, ...], dtype: type = jnp.float32) -> Array:
    return 0.1 * complex_initializer(key, shape, dtype)
