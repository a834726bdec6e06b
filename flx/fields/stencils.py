"""First-order stencils on one-rings: how vector fields and invariant fields see their neighbours.

The field convolution of `flx.fields.convolution` carries vectors to vectors. Here invariant fields t stand
beside vector fields x, and a sum over the ring that goes from order a to order b turns by e^{i(b−a)θ}:
means of either, the gradient of t, the divergence and curl of x (one complex number), and x reflected at the
edges. Weights are fixed; what is learnt comes after, channel by channel at each vertex.

Fields are pairs here, [V, 2C]: the real parts of all channels, then the imaginary parts. An invariant field
is complex for convenience only: two real fields in one. (On XLA:CPU a layer of complex numbers and back
takes twice the time of the same layer on pairs.)
"""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Complex, Float

from flx.fields.convolution import received, rows
from flx.types import OneRings


def stencils(
    rings: OneRings, x: Float[Array, "V C2"], t: Float[Array, "V C2"]
) -> tuple[Float[Array, "V C2"], ...]:
    """Σ w P x, Σ w e^{2iθ} conj(P x), Σ w e^{iθ} t: vectors; Σ w t, Σ w e^{−iθ} P x: invariants.

    e^{iθ} = log/|log| is 0 at the vertex itself, which has no direction.
    """
    r = jnp.abs(rings.logs)
    direction = rings.logs / jnp.where(r > 0, r, 1.0)
    back = jnp.conj(direction) * rings.transports
    carried = (rings.transports, direction * jnp.conj(back), direction, jnp.ones_like(direction), back)
    coefficients = rings.weights * jnp.stack(carried)
    return ring_sums(rings, coefficients, (x, conj(x), t, t, x))


def conj(x: Float[Array, "V C2"]) -> Float[Array, "V C2"]:
    """The complex conjugate of pairs."""
    re, im = jnp.split(x, 2, -1)
    return jnp.concatenate([re, -im], -1)


def times_i(x: Float[Array, "V C2"]) -> Float[Array, "V C2"]:
    """Pairs turned by a quarter."""
    re, im = jnp.split(x, 2, -1)
    return jnp.concatenate([-im, re], -1)


@jax.custom_vjp
def ring_sums(
    rings: OneRings, coefficients: Complex[Array, "N V K"], fields: tuple[Float[Array, "V C2"], ...]
) -> tuple[Float[Array, "V C2"], ...]:
    """Σ_k coefficients_n(p, k) x_n(q_k) for each field x_n. The coefficients are the mesh's: no gradient.

    Each sum is fused into one pass over the slots, and kept apart from what comes before and after it:
    fused with a matrix product XLA:CPU would write every gather to memory.
    """
    coefficients, fields = jax.lax.optimization_barrier((coefficients, fields))
    sums = tuple(_ring_sum(rings, c, x) for c, x in zip(coefficients, fields, strict=True))
    return jax.lax.optimization_barrier(sums)


def _ring_sum(rings: OneRings, coefficients: Complex[Array, "V K"], x: Float[Array, "V C2"]) -> Array:
    slots = range(coefficients.shape[1])
    gathered = [rows(x, rings.neighbors[:, k]) for k in slots]
    re, im = (
        sum(part[:, k, None] * gathered[k] for k in slots)
        for part in (jnp.real(coefficients), jnp.imag(coefficients))
    )
    return re + times_i(im)  # type: ignore


def _forward(rings: OneRings, coefficients: Array, fields: tuple) -> tuple[tuple, tuple]:
    return ring_sums(rings, coefficients, fields), (rings, coefficients)


def _backward(saved: tuple, cotangents: tuple) -> tuple:
    """The transpose is a sum over the ring too: of what p gave to each neighbour, read there, conjugated."""
    rings, coefficients = saved
    given = jax.vmap(received, (None, 0))(rings, coefficients)
    return None, None, ring_sums(rings, jnp.conj(given), cotangents)


ring_sums.defvjp(_forward, _backward)
