"""Our field-latent codec: the coefficients of a cubic polynomial, and MLPs for what it misses.

The ring's colours are fitted by a cubic polynomial. What does not turn with the frame (mean colour,
curvature) goes into invariant channels of the code, what turns like a vector (the gradient and its
change) into vectors, and what turns twice or thrice as fast is turned back by the direction of the
luminance gradient, which is the first vector and which the decoder finds there again. Linear maps, which
start as principal components, choose what to keep; MLPs that work in the gradient's frame refine it.
Equivariant by construction, and 40 times cheaper a ring than a transformer over its samples.
"""

from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Complex, Float

from flx.config import FLVAE
from flx.fields import algebra, polynomials
from flx.models.layers import Posterior, RealMLP
from flx.types import RingSamples

LUMINANCE = np.array([0.299, 0.587, 0.114], np.float32)
TIE = 1e-2  # weight of the samples' own centre in the frame: flat colours have no gradient
RESIDUAL = 0.1  # scale of the MLPs beside the linear maps, at the start
SCALARS, VECTORS = 2 * 3, 4 * 3  # numbers of a cubic polynomial in three colours, by how they turn


class Parts(NamedTuple):
    """A coloured polynomial taken apart by how it turns with the frame."""

    scalars: Float[Array, "*B 6"]  # orders 0
    vectors: Complex[Array, "*B 12"]  # orders 1, 1, 2, 3; 2 and 3 turned back to 1 by the direction
    direction: Complex[Array, "*B"]  # of the luminance gradient


def take_apart(rings: RingSamples) -> Parts:
    """Fit the ring's colours and sort the coefficients."""
    fitted = polynomials.least_squares(rings.logs, rings.colors - 0.5)
    scalars, first, second, third = polynomials.by_order(fitted)
    gradient = first[..., 0, :] @ LUMINANCE.astype(np.complex64)
    direction = algebra.unit(gradient + TIE * jnp.mean(rings.logs, -1))
    back = jnp.conj(direction)[..., None, None]
    vectors = jnp.concatenate([first, second * back, third * back**2], -2)
    return Parts(_flat(scalars), _flat(vectors), direction)


def put_together(
    scalars: Float[Array, "*B 6"], vectors: Complex[Array, "*B 12"], direction: Complex[Array, "*B"]
) -> Float[Array, "*B N 3"]:
    """The coefficients again; the inverse of `take_apart`'s sorting."""
    forth = direction[..., None, None]
    vectors = vectors.reshape(*vectors.shape[:-1], 4, 3)
    first, second, third = vectors[..., :2, :], vectors[..., 2:3, :] * forth, vectors[..., 3:, :] * forth**2
    return polynomials.from_orders(scalars.reshape(*scalars.shape[:-1], 2, 3), first, second, third)


def join(scalars: Float[Array, "*B S"], vectors: Complex[Array, "*B C"]) -> Complex[Array, "*B D"]:
    """Vectors, then pairs of scalars as invariant complex channels: a code."""
    re, im = jnp.split(scalars, 2, -1)
    return jnp.concatenate([vectors, jax.lax.complex(re, im)], -1)


def split(z: Complex[Array, "*B D"], invariants: int) -> tuple[Float[Array, "*B S"], Complex[Array, "*B C"]]:
    """The scalars and the vectors of a code; the inverse of `join`."""
    vectors, pairs = jnp.split(z, [z.shape[-1] - invariants], -1)
    return algebra.real_pairs(pairs), vectors


def _flat(x: Array) -> Array:
    return x.reshape(*x.shape[:-2], -1)


class Encoder(nn.Module):
    """Polynomial parts → scalars and vectors of the code, and their deviations."""

    config: FLVAE

    @nn.compact
    def __call__(self, rings: RingSamples) -> Posterior:
        c = self.config
        kept, count = 2 * c.invariants, c.latents - c.invariants - 1  # the gradient is not chosen
        parts = take_apart(rings)
        zeros = nn.initializers.zeros
        mean = self.param("mean", zeros, (SCALARS,))
        scalars = (parts.scalars - mean) @ self.param("scalars", zeros, (SCALARS, kept))
        vectors = algebra.complex_linear(parts.vectors, self.param("vectors", zeros, (2, VECTORS, 1 + count)))
        upright = parts.vectors * jnp.conj(parts.direction)[..., None]
        seen = jnp.concatenate([parts.scalars, algebra.real_pairs(upright), scalars], -1)
        out = RealMLP((c.decoder_width,) * 3 + (kept + 2 * count + c.latents,), c.precision)(seen)
        more, re, im, log_sigma = jnp.split(out, np.cumsum([kept, count, count]), -1)
        refined = jax.lax.complex(re, im) * parts.direction[..., None]
        vectors = vectors + RESIDUAL * jnp.pad(refined, [(0, 0)] * (refined.ndim - 1) + [(1, 0)])
        return Posterior.starting_small(join(scalars + RESIDUAL * more, vectors), log_sigma)


class Decoder(nn.Module):
    """A code → a polynomial, and an MLP on code and place that adds edges and corners."""

    config: FLVAE

    @nn.compact
    def __call__(self, logs: Complex[Array, "*B"], z: Complex[Array, "*B D"]) -> Float[Array, "*B 3"]:
        c = self.config
        scalars, vectors = split(z, c.invariants)
        direction = algebra.unit(vectors[..., 0])
        zeros = nn.initializers.zeros
        mean = self.param("mean", zeros, (SCALARS,))
        expanded = mean + scalars @ self.param("scalars", zeros, (scalars.shape[-1], SCALARS))
        turning = self.param("vectors", zeros, (2, vectors.shape[-1], VECTORS))
        coefficients = put_together(expanded, algebra.complex_linear(vectors, turning), direction)
        smooth = jnp.einsum("...n,...nc->...c", polynomials.basis(logs), coefficients)
        seen = [
            scalars,
            algebra.real_pairs(vectors * jnp.conj(direction)[..., None]),
            polynomials.basis(logs * jnp.conj(direction))[..., 1:],
            algebra.real_pairs(logs[..., None] * jnp.conj(vectors)),
            smooth,
        ]
        widths = (c.decoder_width,) * (c.decoder_layers - 1) + (3,)
        return 0.5 + smooth + RESIDUAL * RealMLP(widths, c.precision)(jnp.concatenate(seen, -1))


def start_from_principal_components(params: Any, rings: RingSamples) -> Any:
    """Parameters whose linear maps keep most of these rings' colours, and give them back.

    The first vector is the luminance gradient; the others are the principal components of what it does
    not predict, in the metric of mean squared colour differences over the rings. Channels have unit power.
    """
    parts = jax.tree.map(lambda a: np.asarray(a, np.complex128), jax.jit(take_apart)(rings))
    scalars, vectors = parts.scalars.real, parts.vectors
    kept = params["params"]["encoder"]["scalars"].shape[1]
    count = params["params"]["encoder"]["vectors"].shape[2] - 1
    for_scalars, for_vectors = _metrics(np.asarray(polynomials.basis(rings.logs), np.float64))

    mean = scalars.mean(0)
    encode_scalars, decode_scalars = _components(scalars - mean, for_scalars, kept)
    gradient = np.zeros((VECTORS, 1), complex)
    gradient[:3, 0] = LUMINANCE / np.sqrt(np.mean(np.abs(vectors[:, :3] @ LUMINANCE) ** 2))
    leading = vectors @ gradient
    predicted = np.mean(np.conj(leading) * vectors, 0, keepdims=True) / np.mean(np.abs(leading) ** 2)
    rest = vectors - leading @ predicted
    encode_rest, decode_rest = _components(rest, for_vectors, count)
    encode_rest = encode_rest - gradient @ (predicted @ encode_rest)
    linear = {
        "encoder": {
            "mean": mean,
            "scalars": encode_scalars,
            "vectors": _pair(np.concatenate([gradient, encode_rest], 1)),
        },
        "decoder": {
            "mean": mean,
            "scalars": decode_scalars,
            "vectors": _pair(np.concatenate([predicted, decode_rest], 0)),
        },
    }
    changed = {
        part: params["params"][part] | {k: jnp.asarray(v, jnp.float32) for k, v in maps.items()}
        for part, maps in linear.items()
    }
    return {"params": params["params"] | changed}


def _metrics(terms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Square roots of the Gram matrices of scalars and vectors, for three colours each."""
    terms = terms.reshape(-1, polynomials.SIZE)
    gram = terms.T @ terms / len(terms) + 1e-6 * np.eye(polynomials.SIZE)
    zeroth, first, second, third = (np.array(rows) for rows in polynomials.ROWS)
    of_scalars = np.linalg.cholesky(gram[np.ix_(zeroth, zeroth)])
    of_vectors = np.zeros((4, 4))
    of_vectors[:2, :2] = np.linalg.cholesky(gram[np.ix_(first, first)])
    of_vectors[2, 2], of_vectors[3, 3] = (
        np.sqrt(gram[second[0], second[0]]),
        np.sqrt(gram[third[0], third[0]]),
    )
    return np.kron(of_scalars, np.eye(3)), np.kron(of_vectors, np.eye(3))


def _components(x: np.ndarray, metric: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The whitened principal components of the rows of x, and the map back: [N, count], [count, N]."""
    y = x @ metric
    values, vectors = np.linalg.eigh(y.T @ np.conj(y) / len(y))
    scales, axes = np.sqrt(values[::-1][:count]), np.conj(vectors[:, ::-1][:, :count])
    return metric @ axes / scales, np.linalg.solve(metric.T, np.conj(axes) * scales).T


def _pair(weight: np.ndarray) -> np.ndarray:
    """A complex matrix as its (re, im) pair."""
    return np.stack([np.real(weight), np.imag(weight)])
