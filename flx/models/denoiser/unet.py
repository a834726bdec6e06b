"""ε(Z_t, t, ρ, d): what both denoising networks share. A two-level U-Net on the tables of one mesh copy.

How much of the surface the network sees is the design (`flx.models.denoiser.depth`). Subclasses define the
features (vectors, or vectors and invariants), and how they are lifted, pooled, merged and read out.
"""

from typing import Any, ClassVar

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Complex, Float, Float64

from flx.config import FLDM, Blocks
from flx.fields import diffusion
from flx.models.layers import RealMLP, complex_initializer, timestep_features
from flx.types import MeshTables

Features = Any  # an array [V, ...], or a pair of them


class UNet(nn.Module):
    """Blocks at the fine level, pooling, blocks at the coarse level, unpooling, blocks at the fine level.

    For one mesh copy; `vmap` it over copies. `blocks`: their number in each of the three parts.
    """

    config: FLDM
    blocks: Blocks

    # What a subclass provides.
    level: ClassVar[Any]  # (one-rings of a level) → what the blocks there see of the mesh
    Block: ClassVar[Any]  # (config)(features, level, embedding) → (features, None)
    split: ClassVar[Any]  # (z) → features
    dense: ClassVar[Any]  # (channels, name, features) → features: a layer at each vertex
    add: ClassVar[Any]  # (name, features, d [V, n]) → features, plus complex-linear maps of the vectors d
    pool: ClassVar[Any]  # (pooling, fine features) → coarse features
    unpool: ClassVar[Any]  # (pooling, coarse features) → fine features
    merge: ClassVar[Any]  # (features from the coarse level, features that skipped it) → features
    # (features) → answer. It starts small: the loss begins at that of predicting zero, E|ε|² = 2.
    head: ClassVar[Any]

    @nn.compact
    def __call__(
        self,
        tables: MeshTables,
        z: Complex[Array, "V D"],
        t: Float[Array, ""],
        rho: Float[Array, "V m"] | None = None,
        direction: Complex[Array, "V n"] | None = None,
    ) -> Complex[Array, "V D"]:
        """The noise (or velocity) in z at step t, conditioned on scalars ρ and vectors d of each vertex.

        A zero vector is no direction: the maps that take it in have no bias. Raises ValueError where ρ is not
        what `config.conditions` says, or d not what `config.directions` does.
        """
        given = 0 if direction is None else direction.shape[-1]
        if given != self.config.directions:
            raise ValueError(
                f"direction has {given} vectors a vertex; model.directions is {self.config.directions}: make "
                "them equal"
            )

        def told(part: str, x: Features, rows: Any = slice(None)) -> Features:
            return x if direction is None else self.add(f"direction_{part}", x, direction[rows])

        fine, pooling, coarse = self.level(tables.fine), tables.pooling, self.level(tables.coarse)
        before, middle, after = self.blocks
        channels = self.config.channels
        embedding = embed(self.config, t, rho)
        below = embedding if rho is None else embedding[pooling.centers]

        x = self.dense(channels, "lift", self.split(z))
        x = self.run("before", before, told("before", x), fine, embedding)
        y = self.dense(2 * channels, "widen", self.pool(pooling, x))
        # A coarse vertex is a fine one, in its frame: its vector needs no transport.
        y = self.run("coarse", middle, told("coarse", y, pooling.centers), coarse, below)
        x = self.merge(self.unpool(pooling, y), x)
        x = self.run("after", after, told("after", x), fine, embedding)
        return self.head(x)

    def run(self, name: str, count: int, x: Features, level: Any, embedding: Array) -> Features:
        """`count` blocks of one shape, scanned over stacked parameters: compiled once."""
        scan = nn.scan(
            self.Block,
            variable_axes={"params": 0},
            split_rngs={"params": True},
            in_axes=(nn.broadcast, nn.broadcast),  # pyright: ignore[reportArgumentType]
            length=count,
        )
        return scan(self.config, name=name)(x, level, embedding)[0]


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
    network: UNet,
    params: Any,
    tables: MeshTables,
    z: Complex[Array, "V D"],
    t: Float[Array, ""],
    rho: Float[Array, "V m"] | None = None,
    direction: Complex[Array, "V n"] | None = None,
) -> Complex[Array, "V D"]:
    """The noise in z = Z_t, by the network as a function of its parameters.

    The network returns ε, or v = √α_t ε − √(1−α_t) Z (Salimans & Ho 2022): ε = √(1−α_t) Z_t + √α_t v.
    """
    answer: Any = network.apply(params, tables, z, t, rho, direction)
    if network.config.predicts == "noise":
        return answer
    alpha = jnp.asarray(schedule(network.config), jnp.float32)[t.astype(jnp.int32)]
    return jnp.sqrt(1 - alpha) * z + jnp.sqrt(alpha) * answer


def schedule(config: FLDM) -> Float64[np.ndarray, "T"]:
    """α_0 … α_T."""
    return diffusion.linear_schedule(config.steps, config.beta_start, config.beta_end)


def small(key: Array, shape: tuple[int, ...], dtype: type = jnp.float32) -> Array:
    """A tenth of the usual initial weights."""
    return 0.1 * complex_initializer(key, shape, dtype)
