"""Our field-latent codec: a ring's colours as a polynomial seen in its own direction, and MLPs beside it.

The ring's colours are fitted by a polynomial, which is turned upright: seen in the frame of the luminance
gradient. What does not turn with the frame (mean colour, curvature) goes into invariant channels of the code,
the rest into vectors. The first of these is that gradient: the decoder finds the direction there again.
Linear maps, which start as principal components, choose what to keep; an MLP refines it. The decoder works
once a vertex: it makes an upright polynomial and a few soft edges, which are cheap to look up at any point.
Equivariant by construction, and far cheaper than a transformer over the samples.
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
FITTED, PAINTED = 7, 5  # degrees of the polynomials that the encoder sees and the decoder makes
RESIDUAL = 0.01  # scale of the MLPs beside the linear maps, at the start
GAIN = 5.0  # of the MLP's inputs: coefficients of colours are a few tenths
STEEPNESS = 1.5  # of the edges at the start, per mean vertex radius; also the spread of their offsets
BOLDNESS = 10.0  # how much faster than colours the edges' places move with the MLP
_ZEROTH, _PAIRS, _ORDERS = polynomials.rows(FITTED)
SCALARS, VECTORS = (3 * len(rows) for rows in (_ZEROTH, _PAIRS))  # numbers of a fit to three colours
PAINTED_SCALARS, PAINTED_VECTORS = (3 * len(rows) for rows in polynomials.rows(PAINTED)[:2])


class Upright(NamedTuple):
    """The polynomial of a ring's colours, seen in the frame of their luminance gradient."""

    scalars: Float[Array, "*B 12"]  # of order 0
    vectors: Complex[Array, "*B 48"]  # of the others
    direction: Complex[Array, "*B"]  # of the luminance gradient


def upright(rings: RingSamples) -> Upright:
    """Fit the ring's colours, find their direction, and turn it to the x axis."""
    fitted = polynomials.least_squares(rings.logs, rings.colors - 0.5, FITTED)
    scalars, pairs = polynomials.by_order(fitted, FITTED)
    gradient = pairs[..., 0, :] @ LUMINANCE.astype(np.complex64)
    direction = algebra.unit(gradient + TIE * jnp.mean(rings.logs, -1))
    turned = pairs * jnp.conj(direction)[..., None, None] ** np.array(_ORDERS)[:, None]
    return Upright(_flat(scalars), _flat(turned), direction)


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
    """An upright polynomial → scalars and vectors of the code, and their deviations."""

    config: FLVAE

    @nn.compact
    def __call__(self, rings: RingSamples) -> Posterior:
        c = self.config
        kept, count = 2 * c.invariants, c.latents - c.invariants - 1  # the gradient is not chosen
        seen = upright(rings)
        zeros = nn.initializers.zeros
        mean = self.param("mean", zeros, (SCALARS,))
        scalars = (seen.scalars - mean) @ self.param("scalars", zeros, (SCALARS, kept))
        vectors = algebra.complex_linear(seen.vectors, self.param("vectors", zeros, (2, VECTORS, 1 + count)))
        polynomial = jnp.concatenate([seen.scalars, algebra.real_pairs(seen.vectors)], -1)
        features = jnp.concatenate([GAIN * polynomial, scalars, algebra.real_pairs(vectors)], -1)
        outputs = kept + 2 * count + c.latents
        out = RealMLP((c.width,) * c.depth + (outputs,), c.precision, start=RESIDUAL)(features)
        more, re, im, log_sigma = jnp.split(out, np.cumsum([kept, count, count]), -1)
        refined = jax.lax.complex(re, im)
        vectors = vectors + jnp.pad(refined, [(0, 0)] * (refined.ndim - 1) + [(1, 0)])
        turned = vectors * seen.direction[..., None]
        return Posterior.starting_small(join(scalars + more, turned), log_sigma)


class Painting(NamedTuple):
    """What a vertex's code says of the colours around it, in the frame of `direction`."""

    direction: Complex[Array, "*B"]
    coefficients: Float[Array, "*B N 3"]  # of a polynomial
    slopes: Complex[Array, "*B E"]  # soft edges tanh(Re(slope̅ u) + offset) …
    offsets: Float[Array, "*B E"]
    steps: Float[Array, "*B E 3"]  # … and how far colours go on both sides of them


class Decoder(nn.Module):
    """A code → the painting around its vertex → colours."""

    config: FLVAE

    def setup(self) -> None:
        c = self.config
        zeros, spread = nn.initializers.zeros, nn.initializers.normal(STEEPNESS)
        self.mean = self.param("mean", zeros, (PAINTED_SCALARS,))
        self.scalars = self.param("scalars", zeros, (2 * c.invariants, PAINTED_SCALARS))
        self.vectors = self.param("vectors", zeros, (2, c.latents - c.invariants, PAINTED_VECTORS))
        self.slopes = self.param("slopes", spread, (2, c.edges))
        self.offsets = self.param("offsets", spread, (c.edges,))
        outputs = 3 * polynomials.size(PAINTED) + 6 * c.edges
        self.mlp = RealMLP((c.width,) * c.depth + (outputs,), c.precision, start=RESIDUAL)

    def expand(self, z: Complex[Array, "*B D"]) -> Painting:
        """The work of a vertex: all that depends on its code alone."""
        c = self.config
        scalars, vectors = split(z, c.invariants)
        direction = algebra.unit(vectors[..., 0])
        seen = vectors * jnp.conj(direction)[..., None]
        zeroth = _in_colors(self.mean + scalars @ self.scalars)
        pairs = _in_colors(algebra.complex_linear(seen, self.vectors))
        linear = polynomials.from_orders(zeroth, pairs, PAINTED)
        out = self.mlp(jnp.concatenate([scalars, algebra.real_pairs(seen)], -1))
        more, edges = jnp.split(out, [3 * polynomials.size(PAINTED)], -1)
        re, im, offsets, *steps = jnp.split(edges, 6, -1)
        return Painting(
            direction,
            linear + _in_colors(more),
            jax.lax.complex(self.slopes[0] + BOLDNESS * re, self.slopes[1] + BOLDNESS * im),
            self.offsets + BOLDNESS * offsets,
            jnp.stack(steps, -1),
        )

    def __call__(self, painting: Painting, logs: Complex[Array, "*B"]) -> Float[Array, "*B 3"]:
        """The work of a point: the colour at the log from the painting's vertex."""
        u = logs * jnp.conj(painting.direction)
        smooth = jnp.einsum("...n,...nc->...c", polynomials.basis(u, PAINTED), painting.coefficients)
        sides = jnp.tanh(jnp.real(jnp.conj(painting.slopes) * u[..., None]) + painting.offsets)
        return 0.5 + smooth + jnp.einsum("...e,...ec->...c", sides, painting.steps)


def _in_colors(x: Array) -> Array:
    return x.reshape(*x.shape[:-1], -1, 3)


def start_from_principal_components(params: Any, rings: RingSamples) -> Any:
    """Parameters whose linear maps keep most of these rings' colours, and give them back.

    The first vector is the luminance gradient; the others are the principal components of what it does
    not predict, in the metric of mean squared colour differences over the rings. Channels have unit power.
    """
    seen = jax.tree.map(lambda a: np.asarray(a, np.complex128), jax.jit(upright)(rings))
    scalars, vectors = seen.scalars.real, seen.vectors
    kept = params["params"]["encoder"]["scalars"].shape[1]
    count = params["params"]["encoder"]["vectors"].shape[2] - 1
    for_scalars, for_vectors = _metrics(rings.logs)

    mean = scalars.mean(0)
    encode_scalars, decode_scalars = _components(scalars - mean, for_scalars, kept)
    gradient = np.zeros((VECTORS, 1), complex)
    gradient[:3, 0] = LUMINANCE / np.sqrt(np.mean(np.abs(vectors[:, :3] @ LUMINANCE) ** 2))
    leading = vectors @ gradient
    predicted = np.mean(np.conj(leading) * vectors, 0, keepdims=True) / np.mean(np.abs(leading) ** 2)
    rest = vectors - leading @ predicted
    encode_rest, decode_rest = _components(rest, for_vectors, count)
    encode_rest = encode_rest - gradient @ (predicted @ encode_rest)
    encoder = {
        "mean": mean,
        "scalars": encode_scalars,
        "vectors": _pair(np.concatenate([gradient, encode_rest], 1)),
    }
    decoder = {  # coefficients of low degree come first
        "mean": mean[:PAINTED_SCALARS],
        "scalars": decode_scalars[:, :PAINTED_SCALARS],
        "vectors": _pair(np.concatenate([predicted, decode_rest], 0)[:, :PAINTED_VECTORS]),
    }
    linear = {"encoder": encoder, "decoder": decoder}
    return {"params": {part: _replaced(old, linear[part]) for part, old in params["params"].items()}}


def _replaced(params: Any, linear: dict[str, Any]) -> Any:
    """Those of the linear maps that the module has."""
    return params | {name: jnp.asarray(linear[name], jnp.float32) for name in params if name in linear}


def _metrics(logs: Complex[Array, "R S"]) -> tuple[np.ndarray, np.ndarray]:
    """Square roots of the Gram matrices of scalars and vectors, for three colours each.

    Samples count as they do in the fit; terms of different orders are orthogonal on a disc.
    """
    near = np.exp(-(np.abs(logs).ravel() ** 2) / (2 * polynomials.NEAR**2))
    terms = np.asarray(polynomials.basis(logs, FITTED), np.float64).reshape(-1, polynomials.size(FITTED))
    gram = (terms * near[:, None]).T @ terms / near.sum() + 1e-7 * np.eye(polynomials.size(FITTED))
    first, orders = np.array(_PAIRS), np.array(_ORDERS)
    both = (gram[np.ix_(first, first)] + gram[np.ix_(first + 1, first + 1)]) / 2
    of_vectors = np.where(orders[:, None] == orders, both, 0)
    of_scalars = gram[np.ix_(_ZEROTH, _ZEROTH)]
    return np.kron(np.linalg.cholesky(of_scalars), np.eye(3)), np.kron(
        np.linalg.cholesky(of_vectors), np.eye(3)
    )


def _components(x: np.ndarray, metric: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The whitened principal components of the rows of x, and the map back: [N, count], [count, N]."""
    y = x @ metric
    values, vectors = np.linalg.eigh(y.T @ np.conj(y) / len(y))
    scales, axes = np.sqrt(values[::-1][:count]), np.conj(vectors[:, ::-1][:, :count])
    return metric @ axes / scales, np.linalg.solve(metric.T, np.conj(axes) * scales).T


def _pair(weight: np.ndarray) -> np.ndarray:
    """A complex matrix as its (re, im) pair."""
    return np.stack([np.real(weight), np.imag(weight)])
