"""Our field-latent codec: a polynomial fit of a ring's colours in a canonical frame, refined by MLPs.

The polynomial is expressed in the frame of the luminance gradient ("upright"). Quantities that do not turn
with the frame (mean colour, curvature) go into invariant channels of the code, the rest into vectors. In a
code of vectors alone, as the paper's network needs it, they are pairs that turn with the gradient. The first
vector is the gradient, from which the decoder recovers the frame. Linear maps, initialised to principal
components, compress the polynomial, and an MLP refines the result. The decoder runs once per vertex: it
returns an upright polynomial and a few soft edges, which are cheap to evaluate at any point. The codec is
equivariant by construction and far cheaper than a transformer over the samples.
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
TIE = 1e-2  # weight of the samples' centroid in the direction, which breaks the tie if there is no gradient
FITTED_DEGREE, PAINTED_DEGREE = 7, 5  # degrees of the encoder's input polynomial and the decoder's output
RESIDUAL = 0.01  # initial scale of the MLPs that refine the linear maps
GAIN = 5.0  # factor on the MLP's inputs, since colour coefficients are only a few tenths
STEEPNESS = 1.5  # initial spread of the edges' slopes, per mean vertex radius, and of their offsets
FIRMNESS = (
    1.0  # least length of the first vector where pairs turn with it, so that noise leaves its direction
)
BOLDNESS = 10.0  # factor on the MLP's outputs for slopes and offsets, relative to those for colours
_ZEROTH, _PAIRS, _ORDERS = polynomials.coefficient_rows(FITTED_DEGREE)
SCALARS, VECTORS = (3 * len(rows) for rows in (_ZEROTH, _PAIRS))  # coefficients per ring, three colours each
_PAINTED_ROWS = polynomials.coefficient_rows(PAINTED_DEGREE)
PAINTED_SCALARS, PAINTED_VECTORS = (3 * len(rows) for rows in _PAINTED_ROWS[:2])


class Upright(NamedTuple):
    """The polynomial of a ring's colours in the frame of their luminance gradient."""

    scalars: Float[Array, "*B 12"]  # coefficients of order 0
    vectors: Complex[Array, "*B 48"]  # coefficients of the other orders
    direction: Complex[Array, "*B"]  # direction of the luminance gradient in the vertex's frame


def upright(rings: RingSamples) -> Upright:
    """Fit the ring's colours and rotate the polynomial so that the luminance gradient is the x axis."""
    fitted = polynomials.least_squares(rings.logs, rings.colors - 0.5, FITTED_DEGREE)
    scalars, pairs = polynomials.by_order(fitted, FITTED_DEGREE)
    gradient = pairs[..., 0, :] @ LUMINANCE.astype(np.complex64)
    direction = algebra.unit(gradient + TIE * jnp.mean(rings.logs, -1))
    rotated = pairs * jnp.conj(direction)[..., None, None] ** np.array(_ORDERS)[:, None]
    return Upright(_flat(scalars), _flat(rotated), direction)


def join_code(scalars: Float[Array, "*B S"], vectors: Complex[Array, "*B C"]) -> Complex[Array, "*B D"]:
    """A code: the vectors, then the scalars in pairs as complex channels."""
    return jnp.concatenate([vectors, jax.lax.complex(*jnp.split(scalars, 2, -1))], -1)


def split_code(z: Complex[Array, "*B D"], pairs: int) -> tuple[Float[Array, "*B S"], Complex[Array, "*B C"]]:
    """The scalars and the vectors of a code; the inverse of `join_code`."""
    vectors, scalars = jnp.split(z, [z.shape[-1] - pairs], -1)
    return algebra.real_pairs(scalars), vectors


def _flat(x: Array) -> Array:
    return x.reshape(*x.shape[:-2], -1)


def _first(x: Complex[Array, "*B C"], added: float) -> Complex[Array, "*B C"]:
    """The channels with a number added to the first."""
    return x.at[..., 0].add(added)


class Encoder(nn.Module):
    """One-ring samples → upright polynomial → the code's scalars and vectors, and log σ."""

    config: FLVAE

    @nn.compact
    def __call__(self, rings: RingSamples) -> Posterior:
        c = self.config
        scalar_count, vector_count = 2 * c.pairs, c.latents - c.pairs - 1  # without the gradient
        ring = upright(rings)
        zeros = nn.initializers.zeros
        mean = self.param("mean", zeros, (SCALARS,))
        scalars = (ring.scalars - mean) @ self.param("scalars", zeros, (SCALARS, scalar_count))
        weight = self.param("vectors", zeros, (2, VECTORS, 1 + vector_count))
        vectors = algebra.complex_linear(ring.vectors, weight)
        polynomial = jnp.concatenate([ring.scalars, algebra.real_pairs(ring.vectors)], -1)
        features = jnp.concatenate([GAIN * polynomial, scalars, algebra.real_pairs(vectors)], -1)
        outputs = scalar_count + 2 * vector_count + c.latents
        out = RealMLP((c.width,) * c.depth + (outputs,), c.precision, start=RESIDUAL)(features)
        ends = np.cumsum([scalar_count, vector_count, vector_count])
        scalar_residual, re, im, log_sigma = jnp.split(out, ends, -1)
        residual = jax.lax.complex(re, im)
        vectors = vectors + jnp.pad(residual, [(0, 0)] * (residual.ndim - 1) + [(1, 0)])
        scalars, direction = scalars + scalar_residual, ring.direction[..., None]
        if c.invariants:
            code = join_code(scalars, vectors * direction)
        else:
            code = join_code(scalars, _first(vectors, FIRMNESS)) * direction
        return Posterior.starting_small(code, log_sigma)


class Painting(NamedTuple):
    """The colours around a vertex, decoded from its code: a polynomial plus soft edges.

    In the frame of `direction`, edge e adds steps_e · tanh(Re(conj(slope_e) u) + offset_e).
    """

    direction: Complex[Array, "*B"]
    coefficients: Float[Array, "*B N 3"]  # of the polynomial
    slopes: Complex[Array, "*B E"]  # per mean vertex radius
    offsets: Float[Array, "*B E"]
    steps: Float[Array, "*B E 3"]  # colour on the positive side of an edge, less the mean of both sides


class Decoder(nn.Module):
    """A code → the painting around its vertex → colours at points."""

    config: FLVAE

    def setup(self) -> None:
        c = self.config
        zeros, spread = nn.initializers.zeros, nn.initializers.normal(STEEPNESS)
        self.mean = self.param("mean", zeros, (PAINTED_SCALARS,))
        self.scalars = self.param("scalars", zeros, (2 * c.pairs, PAINTED_SCALARS))
        self.vectors = self.param("vectors", zeros, (2, c.latents - c.pairs, PAINTED_VECTORS))
        self.slopes = self.param("slopes", spread, (2, c.edges))
        self.offsets = self.param("offsets", spread, (c.edges,))
        outputs = 3 * polynomials.size(PAINTED_DEGREE) + 6 * c.edges
        self.mlp = RealMLP((c.width,) * c.depth + (outputs,), c.precision, start=RESIDUAL)

    def expand(self, z: Complex[Array, "*B D"]) -> Painting:
        """The work per vertex: everything that depends on its code alone."""
        c = self.config
        direction = algebra.unit(z[..., 0])
        back = jnp.conj(direction)[..., None]
        if c.invariants:
            scalars, vectors = split_code(z, c.pairs)
            rotated = vectors * back
        else:
            scalars, rotated = split_code(_first(z * back, -FIRMNESS), c.pairs)
        zeroth = _in_colors(self.mean + scalars @ self.scalars)
        pairs = _in_colors(algebra.complex_linear(rotated, self.vectors))
        linear = polynomials.from_orders(zeroth, pairs, PAINTED_DEGREE)
        out = self.mlp(jnp.concatenate([scalars, algebra.real_pairs(rotated)], -1))
        residual, edges = jnp.split(out, [3 * polynomials.size(PAINTED_DEGREE)], -1)
        re, im, offsets, *steps = jnp.split(edges, 6, -1)
        return Painting(
            direction,
            linear + _in_colors(residual),
            jax.lax.complex(self.slopes[0] + BOLDNESS * re, self.slopes[1] + BOLDNESS * im),
            self.offsets + BOLDNESS * offsets,
            jnp.stack(steps, -1),
        )

    def __call__(self, painting: Painting, logs: Complex[Array, "*B"]) -> Float[Array, "*B 3"]:
        """The work per point: the colour at a log of the painting's vertex."""
        u = logs * jnp.conj(painting.direction)
        smooth = jnp.einsum("...n,...nc->...c", polynomials.basis(u, PAINTED_DEGREE), painting.coefficients)
        sides = jnp.tanh(jnp.real(jnp.conj(painting.slopes) * u[..., None]) + painting.offsets)
        return 0.5 + smooth + jnp.einsum("...e,...ec->...c", sides, painting.steps)


def _in_colors(x: Array) -> Array:
    return x.reshape(*x.shape[:-1], -1, 3)


def start_from_principal_components(params: Any, rings: RingSamples) -> Any:
    """Parameters whose linear maps encode and decode the principal components of these rings' colours.

    The first vector is the luminance gradient. The others are the principal components of the residual that
    it does not predict, in the metric of mean squared colour differences over the rings. Channels have unit
    power.
    """
    ring = jax.tree.map(lambda a: np.asarray(a, np.complex128), jax.jit(upright)(rings))
    scalars, vectors = ring.scalars.real, ring.vectors
    scalar_count = params["params"]["encoder"]["scalars"].shape[1]
    vector_count = params["params"]["encoder"]["vectors"].shape[2] - 1
    scalar_metric, vector_metric = _metrics(rings.logs)

    mean = scalars.mean(0)
    encode_scalars, decode_scalars = _components(scalars - mean, scalar_metric, scalar_count)
    gradient = np.zeros((VECTORS, 1), complex)
    gradient[:3, 0] = LUMINANCE / np.sqrt(np.mean(np.abs(vectors[:, :3] @ LUMINANCE) ** 2))
    leading = vectors @ gradient
    predicted = np.mean(np.conj(leading) * vectors, 0, keepdims=True) / np.mean(np.abs(leading) ** 2)
    rest = vectors - leading @ predicted
    encode_rest, decode_rest = _components(rest, vector_metric, vector_count)
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
    """The module's parameters with its linear maps replaced; maps that it does not have are ignored."""
    return params | {name: jnp.asarray(linear[name], jnp.float32) for name in params if name in linear}


def _metrics(logs: Complex[Array, "R S"]) -> tuple[np.ndarray, np.ndarray]:
    """Square roots (Cholesky) of the Gram matrices of scalars and of vectors, for three colours each.

    Samples have the weights of the fit; terms of different orders are orthogonal on a disc.
    """
    near = np.exp(-(np.abs(logs).ravel() ** 2) / (2 * polynomials.NEAR**2))
    size = polynomials.size(FITTED_DEGREE)
    terms = np.asarray(polynomials.basis(logs, FITTED_DEGREE), np.float64).reshape(-1, size)
    gram = (terms * near[:, None]).T @ terms / near.sum() + 1e-7 * np.eye(size)
    first, orders = np.array(_PAIRS), np.array(_ORDERS)
    both = (gram[np.ix_(first, first)] + gram[np.ix_(first + 1, first + 1)]) / 2
    of_vectors = np.linalg.cholesky(np.where(orders[:, None] == orders, both, 0))
    of_scalars = np.linalg.cholesky(gram[np.ix_(_ZEROTH, _ZEROTH)])
    return np.kron(of_scalars, np.eye(3)), np.kron(of_vectors, np.eye(3))


def _components(x: np.ndarray, metric: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Whitened principal components of the rows of x: the map to them [N, count], and back [count, N]."""
    y = x @ metric
    values, vectors = np.linalg.eigh(y.T @ np.conj(y) / len(y))
    scales, axes = np.sqrt(values[::-1][:count]), np.conj(vectors[:, ::-1][:, :count])
    return metric @ axes / scales, np.linalg.solve(metric.T, np.conj(axes) * scales).T


def _pair(weight: np.ndarray) -> np.ndarray:
    """A complex matrix as its (re, im) pair."""
    return np.stack([np.real(weight), np.imag(weight)])
