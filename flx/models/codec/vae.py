"""The field-latent VAE: one-ring colours → tangent vectors at the vertex → colours around it.

The code of a ring depends on that ring alone, not on the batch; the colour of a point depends on the codes at
the corners of its face. The encoder commutes with a change of the vertex's frame; the decoder is invariant.
"""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Complex, Float

from flx.config import FLVAE
from flx.fields import algebra
from flx.models.codec import frame, interpolated, transformer
from flx.models.layers import Posterior
from flx.types import Queries, RingSamples


class FieldLatentVAE(nn.Module):
    """Encoder and decoder. Decoding is `expand` once per vertex, then `blend` or `corners` per point."""

    config: FLVAE

    def setup(self) -> None:
        family: Any = FAMILIES[self.config.encoder]
        self.encoder = family.Encoder(self.config)
        decoder: Any = interpolated if self.config.decoder == "interpolated" else family
        self.decoder = decoder.Decoder(self.config)

    def encode(self, rings: RingSamples) -> Posterior:
        """The code of each one-ring, in the frame of its vertex."""
        return self.encoder(rings)

    def expand(self, z: Complex[Array, "V D"]) -> Any:
        """The part of decoding that does not depend on the point: arrays [V, …]."""
        return self.decoder.expand(z)

    def corners(self, expanded: Any, queries: Queries) -> Float[Array, "P 3 3"]:
        """The colour that each corner of a point's face predicts at the point; not clipped to [0, 1]."""
        return self.decoder(_at_corners(expanded, queries), queries.logs)

    def blend(self, expanded: Any, queries: Queries) -> Float[Array, "P 3"]:
        """The colour at each point of a triangulation, continuous across edges; not clipped to [0, 1]."""
        weights = blend_weights(queries.barycentrics, self.config.sharpness)
        if self.config.decoder == "interpolated":
            features = jnp.einsum("pk,pkf->pf", weights, _at_corners(expanded, queries))
            return self.decoder(features)
        return jnp.einsum("pk,pkc->pc", weights, self.corners(expanded, queries))

    def __call__(self, rings: RingSamples, queries: Queries, key: Array) -> tuple[Array, Array, Posterior]:
        """Encode, sample and decode at points of one mesh; returns the blend, the corners, the posterior."""
        posterior = self.encode(rings)
        expanded = self.expand(posterior.sample(key))
        blended = self.blend(expanded, queries)
        if self.config.decoder == "interpolated":
            return blended, blended[:, None], posterior
        return blended, self.corners(expanded, queries), posterior


FAMILIES = {"transformer": transformer, "frame": frame}


def _at_corners(expanded: Any, queries: Queries) -> Any:
    return jax.tree.map(lambda a: a[queries.vertices], expanded)


def blend_weights(barycentrics: Float[Array, "P 3"], sharpness: float) -> Float[Array, "P 3"]:
    """λᵢ^s / Σ λ^s: barycentric for s = 1 (paper); with larger s, each corner dominates more of the face."""
    if sharpness == 1:
        return barycentrics
    weights = barycentrics**sharpness
    return weights / jnp.sum(weights, -1, keepdims=True)


def kl_divergence(posterior: Posterior) -> Float[Array, "*B"]:
    """KL(posterior ‖ standard tangent noise) in nats, summed over the latent channels.

    It is ½|μ|² + σ² − 1 − ln σ² per complex channel. (The paper prints the opposite sign and counts only one
    of the two real coordinates.)
    """
    mean, log_sigma = posterior
    terms = 0.5 * algebra.squared_modulus(mean) + jnp.exp(2 * log_sigma) - 1 - 2 * log_sigma
    return jnp.sum(terms, -1)


def flvae_loss(
    colors: Float[Array, "*#P 3"], predicted: Float[Array, "*#P 3"], posterior: Posterior, kl_weight: float
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """L1 summed over RGB plus the weighted KL summed over D, each averaged over all else; and the metrics.

    `predicted` may hold several predictions of one colour, those of a face's corners.
    """
    l1 = jnp.mean(jnp.sum(jnp.abs(predicted - colors), -1))
    kl = jnp.mean(kl_divergence(posterior))
    psnr = -10 * jnp.log10(jnp.mean((jnp.clip(predicted, 0, 1) - colors) ** 2) + 1e-10)
    return l1 + kl_weight * kl, {"l1": l1, "kl": kl, "psnr": psnr}
