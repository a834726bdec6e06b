"""First-order stencils on one-rings, between vector fields x and invariant fields t.

`flx.fields.convolution` maps vectors to vectors. Here there are invariant fields as well, and a sum over the
ring that maps order a to order b has the phase e^{i(b−a)θ}: the means of x and t, the gradient of t, the
divergence and curl of x (one complex number), and x reflected at the edges. The weights are fixed; the learnt
layers follow, at each vertex.

Fields are pairs [V, 2C]: the real parts of all channels, then the imaginary parts. An invariant field is
complex for convenience only: it is two real fields. (On XLA:CPU a layer that converts to complex numbers and
back takes twice the time of the same layer on pairs.)
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Complex, Float, Int

from flx.fields.convolution import gather, gather_reverse
from flx.types import OneRings


class Stencils(NamedTuple):
    """What the sums over the one-rings of a level need of the mesh, the same for every layer there."""

    masses: Float[Array, "V"]
    neighbors: Int[Array, "V K"]
    sent: Complex[Array, "N V K"]  # the coefficient of neighbour k in sum n at p
    returned: Complex[Array, "N V K"]  # the coefficient of p in sum n at its neighbour k


def of_rings(rings: OneRings) -> Stencils:
    """The five stencils of `stencils`. e^{iθ} = log/|log| is 0 at the vertex itself: it has no direction."""
    r = jnp.abs(rings.logs)
    direction = rings.logs / jnp.where(r > 0, r, 1.0)
    back = jnp.conj(direction) * rings.transports
    carried = (rings.transports, direction * jnp.conj(back), direction, jnp.ones_like(direction), back)
    sent = rings.weights * jnp.stack(carried)
    returned = jax.vmap(gather_reverse, (None, 0))(rings, sent)
    # Else XLA would compute them again in every layer. Apart: without gradients, nobody asks for `returned`.
    sent, returned = (jax.lax.optimization_barrier(a) for a in (sent, returned))
    return Stencils(rings.masses, rings.neighbors, sent, returned)


def stencils(
    rings: Stencils, x: Float[Array, "V C2"], t: Float[Array, "V C2"]
) -> tuple[Float[Array, "V C2"], ...]:
    """The vectors Σ w P x, Σ w e^{2iθ} conj(P x), Σ w e^{iθ} t; the invariants Σ w t, Σ w e^{−iθ} P x."""
    return ring_sums(rings, (x, conj(x), t, t, x))


def conj(x: Float[Array, "V C2"]) -> Float[Array, "V C2"]:
    """The complex conjugates of pairs."""
    re, im = jnp.split(x, 2, -1)
    return jnp.concatenate([re, -im], -1)


def times_i(x: Float[Array, "V C2"]) -> Float[Array, "V C2"]:
    """i x, for pairs."""
    re, im = jnp.split(x, 2, -1)
    return jnp.concatenate([-im, re], -1)


@jax.custom_vjp
def ring_sums(rings: Stencils, fields: tuple[Float[Array, "V C2"], ...]) -> tuple[Float[Array, "V C2"], ...]:
    """Σ_k sent_n(p, k) x_n(q_k) for each field x_n. Coefficients depend on the mesh: no gradient.

    Each sum is fused into one pass over the slots. The barriers keep it apart from the operations around it:
    fused with a matrix product, XLA:CPU would write every gather to memory.
    """
    sent, fields = jax.lax.optimization_barrier((rings.sent, fields))
    sums = tuple(_ring_sum(rings.neighbors, c, x) for c, x in zip(sent, fields, strict=True))
    return jax.lax.optimization_barrier(sums)


@jax.jit  # traced once for all sums of a shape, which are many: their tracing took a third of a program's
def _ring_sum(
    neighbors: Int[Array, "V K"], coefficients: Complex[Array, "V K"], x: Float[Array, "V C2"]
) -> Float[Array, "V C2"]:
    slots = range(coefficients.shape[1])
    gathered = [gather(x, neighbors[:, k]) for k in slots]
    re, im = (
        sum(part[:, k, None] * gathered[k] for k in slots)
        for part in (jnp.real(coefficients), jnp.imag(coefficients))
    )
    return re + times_i(im)  # type: ignore


def _forward(rings: Stencils, fields: tuple) -> tuple[tuple, Stencils]:
    return ring_sums(rings, fields), rings


def _backward(rings: Stencils, cotangents: tuple) -> tuple:
    """The transpose is also a sum over the ring, with the conjugate coefficients of the reverse edges."""
    transposed = rings._replace(sent=jnp.conj(rings.returned), returned=jnp.conj(rings.sent))
    return None, ring_sums(transposed, cotangents)


ring_sums.defvjp(_forward, _backward)
