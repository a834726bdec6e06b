"""Field convolutions, and pooling between two levels, on the padded tables of one mesh.

`(X * f)_{c'}(p) = Σ_k w_pk Σ_c Y_pkc f_{c'c}(u_pkc, π(q_k))`, Y = P_{p←q} X(q), u = log_p q · conj(Y/|Y|).
(Paper, supplement B.2. As printed, r e^{i(θ_pq − φ_q)} mixes the frames of p and q; u is the argument in
the frame of p. The 2021 paper's log_q p differs from ours by the factor −1.)

Both filters are f_{c'c} = Σ_h W_{c'c,h} h(u, π): the sum over the ring comes first, then the dense W
(PointConv). So W is the third layer of the paper's three-layer MLP, and h the two inner ones.

- `mlp` (the paper): h is a real MLP of (Re u, Im u, π), evaluated for each edge and channel.
- `harmonic` (ours): h(r e^{iα}, π) = g_h(r, π) e^{imα}, m ∈ {0, 1, 2}, with g evaluated once per edge. Then
  Y h(u) = κ_h(p, k) P_m(q): powers P of the vectors, P_0 = X, P_1 = |X|, P_2 = conj X, and coefficients
  κ = w g e^{i(mθ + (1−m)φ_pq)} that do not depend on the channel.

No function scatters: the backward pass of a gather over a ring gathers through `reverse`, where slot k of p
is slot `reverse` of q = neighbors[p, k]. On complex arrays JAX's cotangent is the plain transpose, so nothing
is conjugated there. Spare slots have weight 0 and reverse to themselves, so they send and receive zeros.
"""

import math

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Complex, Float, Int

from flx.config import Filter, Precision
from flx.fields.algebra import complex_linear, squared_modulus, unit
from flx.types import OneRings, Pooling

Parameters = dict[str, Array]

INPUTS = {"harmonic": 1, "mlp": 2}  # number of geometric inputs: r; Re u and Im u
SMOOTHING = 1e-4  # δ of |X| ≈ |X|² / √(|X|² + δ)


def field_conv(
    rings: OneRings,
    x: Complex[Array, "V C"],
    parameters: Parameters,
    embedding: Float[Array, "V E"] | Float[Array, "E"] | None = None,
    filter: Filter = "harmonic",
    precision: Precision = "float32",
) -> Complex[Array, "V D"]:
    """Convolve vector fields with a filter bank that also depends on a scalar embedding π at q.

    `parameters` are those of `init_filter`; `embedding` is π, one for each vertex or one for all.
    Paper, supplement B.2. Raises ValueError for parameters of another filter, width or embedding.
    """
    _check(x, parameters, embedding, filter)
    shift = parameters["shift"]
    if embedding is not None:
        shift = shift + embedding @ parameters["embedding"]
    respond = {"harmonic": _harmonic_response, "mlp": _mlp_response}[filter]
    response = respond(rings, x, shift, parameters)
    return complex_linear(response.reshape(x.shape[0], -1), parameters["output"], precision)


def _check(x: Array, parameters: Parameters, embedding: Array | None, filter: Filter) -> None:
    """Shapes alone: it costs nothing in a compiled program."""
    inputs, width = parameters["input"].shape
    if not jnp.issubdtype(x.dtype, jnp.complexfloating):
        raise ValueError(f"x is {x.dtype}; give complex numbers, the vectors in the frames of their vertices")
    if inputs != INPUTS[filter]:
        other = next(name for name in INPUTS if name != filter)
        raise ValueError(f"the parameters are not those of filter={filter!r}; use filter={other!r}")
    if parameters["output"].shape[1] != width * x.shape[-1]:
        channels = parameters["output"].shape[1] // width
        raise ValueError(f"x has {x.shape[-1]} channels, but the parameters are for {channels}")
    if (embedding is not None) != ("embedding" in parameters):
        needed = "need an embedding" if embedding is None else "take no embedding; see init_filter"
        raise ValueError(f"the parameters {needed}")


def init_filter(
    key: Array, channels: int, features: int, embedding: int = 0, width: int = 8, filter: Filter = "harmonic"
) -> Parameters:
    """Parameters of one filter bank C → D: real arrays, with complex weights as (re, im).

    `embedding` is E, or 0 for a filter without one. The scale preserves the second moment of tangent noise on
    a regular ring of seven, which their mean alone would divide by seven.
    """
    keys = jax.random.split(key, 5)
    parameters = {
        "input": jax.random.normal(keys[0], (INPUTS[filter], width)),
        "shift": jax.random.normal(keys[1], (width,)),
        "hidden": jax.random.normal(keys[2], (width, width)) * math.sqrt(2 / width),
        "bias": jnp.zeros((width,)),
    }
    if embedding:
        parameters["embedding"] = jax.random.normal(keys[4], (embedding, width)) / math.sqrt(embedding)
    # The vertex itself and six neighbours at the edge length of the regular triangulation, √(2π/√3) r̄.
    angles = jnp.arange(6) * math.pi / 3
    length = math.sqrt(2 * math.pi / math.sqrt(3))
    circle = length * (
        jnp.ones((6, 1)) if filter == "harmonic" else jnp.stack([jnp.cos(angles), jnp.sin(angles)], 1)
    )
    h = _profile(parameters, jnp.concatenate([jnp.zeros((1, INPUTS[filter])), circle]), parameters["shift"])
    gain = jnp.sum(jnp.mean(h**2, 1)) / 7**2
    scale = jax.lax.rsqrt(2 * width * channels * gain)
    return parameters | {"output": scale * jax.random.normal(keys[3], (2, width * channels, features))}


def _profile(parameters: Parameters, inputs: Float[Array, "*V I"], shift: Array) -> Float[Array, "*V H"]:
    """The two inner layers, h or g, in real arithmetic."""
    hidden = jax.nn.silu(inputs @ parameters["input"] + shift)
    return jax.nn.silu(hidden @ parameters["hidden"] + parameters["bias"])


def gather(x: Array, index: Int[Array, "*I"]) -> Array:
    """x[index] without bounds checks, so that XLA fuses the gather; indices must be valid."""
    return x.at[index].get(mode="promise_in_bounds")


def gather_reverse(rings: OneRings, sent: Array) -> Array:
    """The values [V, K, …] that each vertex receives, where `sent` holds those it sends along its slots."""
    return sent.at[rings.neighbors, rings.reverse].get(mode="promise_in_bounds")


@jax.custom_vjp
def _ring_values(rings: OneRings, x: Float[Array, "V H"]) -> Float[Array, "V K H"]:
    """The scalars x at the neighbours. The cotangent must vanish on spare slots."""
    return gather(x, rings.neighbors)


_ring_values.defvjp(
    lambda rings, x: (_ring_values(rings, x), rings),
    lambda rings, cotangent: (None, gather_reverse(rings, cotangent).sum(1)),
)


# --- harmonic -------------------------------------------------------------------------------------------


def _harmonic_response(
    rings: OneRings, x: Complex[Array, "V C"], shift: Array, parameters: Parameters
) -> Complex[Array, "V H C"]:
    """Σ_k κ_h(p, k) P_m(q_k), with the orders m distributed over the H filter channels."""
    r = jnp.abs(rings.logs)
    at_neighbors = shift if shift.ndim == 1 else _ring_values(rings, shift)
    g = _profile(parameters, r[..., None], at_neighbors)

    # (log/|log|)^m with 0⁰ = 1 and 0^m = 0: the self slot has no direction, so it contributes to m = 0 only.
    direction = rings.logs / jnp.where(r > 0, r, 1.0)
    phases = (rings.transports, direction, direction**2 * jnp.conj(rings.transports))
    kappa = jnp.stack([rings.weights * phases[m] for m in _orders(g.shape[-1])]) * jnp.moveaxis(g, -1, 0)
    return jnp.moveaxis(_ring_sums(rings, kappa, x), 0, 1)


def _orders(width: int) -> list[int]:
    """The order m of each filter channel: for eight, 0 0 0 1 1 1 2 2."""
    return [3 * h // width for h in range(width)]


def _powers(x: Complex[Array, "V C"], width: int) -> Complex[Array, "H V C"]:
    """P_m = |X| e^{i(1−m)φ} for each filter channel, with |X| smooth at zero."""
    s = squared_modulus(x)
    powers = (x, (s * jax.lax.rsqrt(s + SMOOTHING)).astype(x.dtype), jnp.conj(x))
    return jnp.stack([powers[m] for m in _orders(width)])


@jax.custom_vjp
def _ring_sums(
    rings: OneRings, kappa: Complex[Array, "H V K"], x: Complex[Array, "V C"]
) -> Complex[Array, "H V C"]:
    """Σ_k κ_h(p, k) P_h(q_k), one filter channel at a time.

    Unrolled over the slots, the sum is fused by XLA into one pass. The loop over h prevents that pass from
    being fused with the operations before and after it, which takes 20 times as long (measured).
    """

    def one(_: None, channel: tuple[Array, Array]) -> tuple[None, Array]:
        return None, _gathered_sum(rings.neighbors, *channel)

    return jax.lax.scan(one, None, (kappa, _powers(x, len(kappa))))[1]


@jax.jit  # traced once for all sums of a shape
def _gathered_sum(
    index: Int[Array, "V K"], kappa: Complex[Array, "V K"], y: Complex[Array, "Q C"]
) -> Complex[Array, "V C"]:
    """Σ_k κ(p, k) y(index(p, k)), unrolled over k."""
    slots = range(kappa.shape[1])
    return sum(kappa[:, k, None] * gather(y, index[:, k]) for k in slots)  # type: ignore


def _ring_sums_forward(rings: OneRings, kappa: Array, x: Array) -> tuple[Array, tuple]:
    return _ring_sums(rings, kappa, x), (rings, kappa, x)


def _ring_sums_backward(saved: tuple, cotangent: Array) -> tuple:
    rings, kappa, x = saved
    powers, to_x = jax.vjp(lambda x: _powers(x, len(kappa)), x)

    def one(_: None, channel: tuple[Array, Array, Array]) -> tuple[None, tuple[Array, Array]]:
        kappa, power, bar = channel
        power_bar = _gathered_sum(rings.neighbors, gather_reverse(rings, kappa), bar)
        slots = range(kappa.shape[1])
        dots = [_row_dots(bar, gather(power, rings.neighbors[:, k])) for k in slots]
        return None, (jnp.stack(dots, 1), power_bar)

    kappa_bar, powers_bar = jax.lax.scan(one, None, (kappa, powers, cotangent))[1]
    return None, kappa_bar, *to_x(powers_bar)


def _row_dots(a: Complex[Array, "V C"], b: Complex[Array, "V C"]) -> Complex[Array, "V"]:
    """Σ_c a_c b_c, first in blocks of one vector register, because XLA does not vectorise a fused complex sum
    on the CPU (measured: 34 → 8 ms for a convolution)."""
    lanes = math.gcd(a.shape[-1], 16)
    blocks = (a[:, s : s + lanes] * b[:, s : s + lanes] for s in range(0, a.shape[-1], lanes))
    return jnp.sum(sum(blocks), -1)  # type: ignore


_ring_sums.defvjp(_ring_sums_forward, _ring_sums_backward)


# --- mlp --------------------------------------------------------------------------------------------------


def _mlp_response(
    rings: OneRings, x: Complex[Array, "V C"], shift: Array, parameters: Parameters
) -> Complex[Array, "V H C"]:
    """Σ_k w Y h(u, π(q_k))."""
    shift = jnp.broadcast_to(shift, (x.shape[0], shift.shape[-1]))
    weights = {name: parameters[name] for name in ("input", "hidden", "bias")}
    return _messages(rings, x, shift, weights)


def _message(
    edge: tuple[Complex[Array, "V"], Complex[Array, "V"]],
    x: Complex[Array, "V C"],
    shift: Float[Array, "V H"],
    weights: Parameters,
) -> Complex[Array, "V H C"]:
    """w Y h(u, π) along one edge per vertex, from (log conj P, w P) of the edge and X, π at its q.

    Weights are repeated for each vertex, so that their gradients are first summed along rows, which is fast.
    """
    argument, transport = edge
    vertices = x.shape[0]

    def tiled(weight: Float[Array, "H"]) -> Float[Array, "V H 1"]:
        return jnp.broadcast_to(weight, (vertices, *weight.shape))[..., None]

    u = argument[:, None] * jnp.conj(unit(x))
    a, b = tiled(weights["input"][0]), tiled(weights["input"][1])
    hidden = jax.nn.silu(a * jnp.real(u)[:, None] + b * jnp.imag(u)[:, None] + shift[..., None])
    mixing = jnp.broadcast_to(weights["hidden"].T, (vertices, *weights["hidden"].shape))
    h = jax.nn.silu(jnp.einsum("vgh,vhc->vgc", mixing, hidden) + tiled(weights["bias"]))
    return (transport[:, None] * x)[:, None] * h


def _mlp_edges(rings: OneRings) -> tuple[Complex[Array, "V K"], Complex[Array, "V K"]]:
    return rings.logs * jnp.conj(rings.transports), rings.weights * rings.transports


@jax.custom_vjp
def _messages(rings: OneRings, x: Array, shift: Array, weights: Parameters) -> Array:
    """The sum of the messages over the ring, one slot at a time, so that [V, K, C, H] is never in memory."""

    def receive(total: Array, slot: tuple) -> tuple[Array, None]:
        q, edge = slot
        return total + _message(edge, gather(x, q), gather(shift, q), weights), None

    zeros = jnp.zeros((x.shape[0], shift.shape[1], x.shape[1]), x.dtype)
    slots = (rings.neighbors.T, tuple(e.T for e in _mlp_edges(rings)))
    return jax.lax.scan(receive, zeros, slots)[0]


def _messages_forward(rings: OneRings, x: Array, shift: Array, weights: Parameters) -> tuple[Array, tuple]:
    return _messages(rings, x, shift, weights), (rings, x, shift, weights)


def _messages_backward(saved: tuple, cotangent: Array) -> tuple:
    """Each vertex recomputes its messages and gathers their cotangents from the neighbours."""
    rings, *primals = saved

    def send(total: list, slot: tuple) -> tuple[list, None]:
        p, edge = slot
        _, pull = jax.vjp(lambda *primals: _message(edge, *primals), *primals)
        return jax.tree.map(jnp.add, total, list(pull(gather(cotangent, p)))), None

    zeros = jax.tree.map(jnp.zeros_like, primals)
    slots = (rings.neighbors.T, tuple(gather_reverse(rings, e).T for e in _mlp_edges(rings)))
    return None, *jax.lax.scan(send, zeros, slots)[0]


_messages.defvjp(_messages_forward, _messages_backward)


# --- pooling ----------------------------------------------------------------------------------------------


@jax.custom_vjp
def pool(pooling: Pooling, x: Complex[Array, "V C"]) -> Complex[Array, "W C"]:
    """The mass-weighted mean over each cluster of vectors transported to its centre."""
    return _gathered_sum(pooling.children, pooling.child_weights * pooling.child_transports, x)


def _pool_backward(pooling: Pooling, cotangent: Array) -> tuple:
    # A vertex looks up its own weight in its cluster; spare entries repeat the centre with weight 0.
    me = jnp.arange(pooling.parents.shape[0])[:, None]
    mine = gather(pooling.children, pooling.parents) == me
    weight = jnp.sum(jnp.where(mine, gather(pooling.child_weights, pooling.parents), 0.0), 1)
    return None, (weight * pooling.transports)[:, None] * gather(cotangent, pooling.parents)


pool.defvjp(lambda pooling, x: (pool(pooling, x), pooling), _pool_backward)


@jax.custom_vjp
def unpool(pooling: Pooling, x: Complex[Array, "W C"]) -> Complex[Array, "V C"]:
    """Each fine vertex takes the vector of its cluster, transported by P_{v←parent} = conj P_{parent←v}."""
    return jnp.conj(pooling.transports)[:, None] * gather(x, pooling.parents)


def _unpool_backward(pooling: Pooling, cotangent: Array) -> tuple:
    carry = jnp.where(pooling.child_weights > 0, jnp.conj(pooling.child_transports), 0.0)
    return None, _gathered_sum(pooling.children, carry, cotangent)


unpool.defvjp(lambda pooling, x: (unpool(pooling, x), pooling), _unpool_backward)
