"""The field-latent VAE: one-ring colours → tangent vectors at the vertex → colours around it.

Everything is pointwise: a ring's code depends on that ring alone, whatever else is in the batch.
The encoder commutes with a change of the vertex's frame, the decoder is invariant under it.
"""

from typing import Any

import flax.linen as nn
import jax.numpy as jnp
from jax import Array
from jaxtyping import Complex, Float

from flx.config import FLVAE
from flx.fields import algebra
from flx.models import frame, transformer
from flx.models.layers import Posterior
from flx.types import RingSamples


class FieldLatentVAE(nn.Module):
    """Encoder and decoder; `encode` and `decode` below apply them."""

    config: FLVAE

    def setup(self) -> None:
        check(self.config)
        family = {"transformer": transformer, "frame": frame}[self.config.encoder]
        self.encoder = family.Encoder(self.config)
        self.decoder = family.Decoder(self.config)

    def encode(self, rings: RingSamples) -> Posterior:
        """The code of each one-ring, in the frame of its vertex."""
        return self.encoder(rings)

    def decode(self, logs: Complex[Array, "*B"], z: Complex[Array, "*B D"]) -> Float[Array, "*B 3"]:
        """The colour at the point log away from the vertex that z belongs to; about [0, 1], not clipped."""
        return self.decoder(logs, z)

    def __call__(
        self, rings: RingSamples, queries: Complex[Array, "*B Q"], key: Array
    ) -> tuple[Float[Array, "*B Q 3"], Posterior]:
        """Encode, sample and decode at the queries: what training needs."""
        posterior = self.encode(rings)
        z = posterior.sample(key)
        z = jnp.broadcast_to(z[..., None, :], (*queries.shape, z.shape[-1]))
        return self.decode(queries, z), posterior


def check(config: FLVAE) -> None:
    """Raises ValueError where the encoder cannot make codes of this kind."""
    invariants, latents = config.invariants, config.latents
    if config.encoder == "transformer" and invariants:
        raise ValueError(
            f"model.invariants is {invariants}, but the transformer's codes are vectors: make it 0"
        )
    if config.encoder == "frame" and not (1 <= invariants <= 3 and invariants < latents <= invariants + 12):
        raise ValueError(
            f"model.invariants is {invariants} of {latents} latents; the frame encoder has 1 to 3, "
            "and 1 to 12 vectors beside them"
        )


def encode(config: FLVAE, params: Any, rings: RingSamples) -> Posterior:
    """`FieldLatentVAE.encode` as a function of its parameters."""
    return FieldLatentVAE(config).apply(params, rings, method=FieldLatentVAE.encode)  # type: ignore


def decode(
    config: FLVAE, params: Any, logs: Complex[Array, "*B"], z: Complex[Array, "*B D"]
) -> Float[Array, "*B 3"]:
    """`FieldLatentVAE.decode` as a function of its parameters."""
    return FieldLatentVAE(config).apply(params, logs, z, method=FieldLatentVAE.decode)  # type: ignore


def kl_divergence(posterior: Posterior) -> Float[Array, "*B"]:
    """KL(posterior ‖ standard tangent noise) in nats, summed over the latent channels.

    ½|μ|² + σ² − 1 − ln σ² per complex channel. (The paper prints the opposite sign and counts one of
    the two real coordinates.)
    """
    mean, log_sigma = posterior
    terms = 0.5 * algebra.squared_modulus(mean) + jnp.exp(2 * log_sigma) - 1 - 2 * log_sigma
    return jnp.sum(terms, -1)


def flvae_loss(
    colors: Float[Array, "*B Q 3"],
    predicted: Float[Array, "*B Q 3"],
    posterior: Posterior,
    kl_weight: float,
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """L1 summed over RGB plus the weighted KL summed over D, means over all else; with its metrics."""
    l1 = jnp.mean(jnp.sum(jnp.abs(predicted - colors), -1))
    kl = jnp.mean(kl_divergence(posterior))
    psnr = -10 * jnp.log10(jnp.mean((jnp.clip(predicted, 0, 1) - colors) ** 2) + 1e-10)
    return l1 + kl_weight * kl, {"l1": l1, "kl": kl, "psnr": psnr}
