"""Laws of the field convolutions and of pooling, against a reference in plain loops."""

import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.frames import field, padded, relative, tables_of, turned
from helpers.surfaces import icosphere, square_grid, torus

from flx.fields.algebra import tangent_noise
from flx.fields.convolution import SMOOTHING, _check, field_conv, init_filter, pool, unpool
from flx.types import OneRings, Pooling

FILTERS = ("harmonic", "mlp")
C, D, E = 5, 3, 4
SPHERE = tables_of(icosphere(1))  # 42 vertices
TORUS = tables_of(torus(8, 6))
OPEN = tables_of(square_grid(6))
SURFACES = {"sphere": SPHERE, "torus": TORUS, "square": OPEN}


def slow(*cases: str) -> list:
    return [pytest.param(case, marks=pytest.mark.slow) for case in cases]


@functools.cache
def parameters_of(filter: str, embedding: int = E):
    return init_filter(jax.random.key(7), C, D, embedding, 8, filter)


def embedding_of(vertices: int):
    return jax.random.normal(jax.random.key(3), (vertices, E))


def naive(rings: OneRings, x, parameters, embedding, filter: str) -> np.ndarray:
    """The definition in complex128, one edge and one channel at a time."""
    p = {name: np.asarray(a, np.float64) for name, a in parameters.items()}
    neighbors, logs, transports, weights = (np.asarray(a) for a in (rings[0], *rings[2:5]))
    x = np.asarray(x, np.complex128)
    shift = np.asarray(embedding, np.float64) @ p["embedding"] + p["shift"]

    def silu(z):
        return z / (1 + np.exp(-z))

    def profile(inputs, q):
        return silu(silu(inputs @ p["input"] + shift[q]) @ p["hidden"] + p["bias"])

    vertices, slots = neighbors.shape
    response = np.zeros((vertices, 8, C), np.complex128)
    for v in range(vertices):
        for k in range(slots):
            q, log = neighbors[v, k], complex(logs[v, k])
            for c in range(C):
                y = transports[v, k] * x[q, c]
                if filter == "mlp":
                    u = log * np.conj(y) / np.sqrt(abs(y) ** 2 + 1e-12)
                    response[v, :, c] += weights[v, k] * y * profile(np.array([u.real, u.imag]), q)
                    continue
                g = profile(np.array([abs(log)]), q)
                for h, m in enumerate((0, 0, 0, 1, 1, 1, 2, 2)):
                    # y e^{imα} for α = arg(log) − arg(y); without a direction only m = 0 is defined.
                    alpha = np.angle(log) - np.angle(y)
                    value = 1 if m == 0 else (0 if log == 0 else np.exp(1j * m * alpha))
                    size = abs(y) / np.sqrt(abs(y) ** 2 + SMOOTHING) if m == 1 else 1
                    response[v, h, c] += weights[v, k] * y * size * value * g[h]
    weight = p["output"][0] + 1j * p["output"][1]
    return response.reshape(vertices, -1) @ weight


@pytest.mark.parametrize("surface", ["sphere", *slow("torus", "square")])
@pytest.mark.parametrize("filter", FILTERS)
def test_convolution_is_its_definition(filter, surface):
    rings = SURFACES[surface].fine
    x, embedding = field(len(rings.masses)), embedding_of(len(rings.masses))
    result = field_conv(rings, x, parameters_of(filter), embedding, filter)
    assert relative(result, naive(rings, x, parameters_of(filter), embedding, filter)) < 1e-5


@pytest.mark.parametrize("level", ["fine", *slow("coarse")])
@pytest.mark.parametrize("filter", FILTERS)
def test_convolution_turns_with_the_frames(filter, level):
    alpha = np.random.default_rng(0).uniform(0, 2 * np.pi, len(TORUS.fine.masses))
    rings, turned_rings = getattr(TORUS, level), getattr(turned(TORUS, alpha), level)
    if level == "coarse":
        alpha = alpha[np.asarray(TORUS.pooling.centers)]
    turn = np.exp(1j * alpha)[:, None].astype(np.complex64)
    x, embedding = field(len(turn)), embedding_of(len(turn))
    parameters = parameters_of(filter)
    expected = turn * field_conv(rings, x, parameters, embedding, filter)
    assert relative(field_conv(turned_rings, turn * x, parameters, embedding, filter), expected) < 1e-5


@pytest.mark.parametrize("filter", FILTERS)
def test_the_numbering_of_vertices_means_nothing(filter):
    rings = TORUS.fine
    x, embedding = field(len(rings.masses)), embedding_of(len(rings.masses))
    order = np.random.default_rng(1).permutation(len(x))  # new vertex i is old vertex order[i]
    place = np.argsort(order)
    renumbered = OneRings(
        jnp.asarray(place[np.asarray(rings.neighbors)[order]], jnp.int32), *(a[order] for a in rings[1:])
    )
    parameters = parameters_of(filter)
    expected = field_conv(rings, x, parameters, embedding, filter)[order]
    assert relative(field_conv(renumbered, x[order], parameters, embedding[order], filter), expected) < 1e-5


@pytest.mark.parametrize("filter", FILTERS)
def test_padding_is_inert_forward_and_backward(filter):
    rings, count = OPEN.fine, len(OPEN.fine.masses)
    x, embedding, target = field(count), embedding_of(count), field(count, D, seed=5)

    def loss(rings, x, parameters, embedding, target):
        y = field_conv(rings, x, parameters, embedding, filter)
        return jnp.sum(jnp.real(jnp.conj(target) * y)), y

    # What stands in the spare rows may be anything finite.
    def grown(a):
        return jnp.concatenate([a, jnp.full((3, a.shape[1]), 2.0, a.dtype)])

    gradient = jax.jit(jax.grad(loss, (1, 2, 3), has_aux=True))
    plain, y = gradient(rings, x, parameters_of(filter), embedding, target)
    spare, spare_y = gradient(padded(rings), grown(x), parameters_of(filter), grown(embedding), grown(target))
    assert relative(spare_y[:count], y) < 1e-6
    assert relative(spare[0][:count], plain[0]) < 1e-5
    assert relative(spare[2][:count], plain[2]) < 1e-5
    assert jnp.all(spare[0][count:] == 0)
    for name in plain[1]:
        assert relative(spare[1][name], plain[1][name]) < 1e-5, name


def plain_conv(rings: OneRings, x, parameters, embedding, filter: str):
    """The same equations over [V, K, C, H] arrays, left to autodiff: scatters, and much memory."""
    p = parameters
    transports, weights = rings.transports[..., None], rings.weights[..., None]
    y = transports * x[rings.neighbors]
    shift = (embedding @ p["embedding"] + p["shift"])[rings.neighbors]
    if filter == "mlp":
        u = rings.logs[..., None] * jnp.conj(y * jax.lax.rsqrt(jnp.real(y * jnp.conj(y)) + 1e-12))
        inputs = jnp.stack([u.real, u.imag], -1)
        hidden = jax.nn.silu(inputs @ p["input"] + shift[:, :, None])
        response = (weights * y)[..., None] * jax.nn.silu(hidden @ p["hidden"] + p["bias"])
    else:
        r = jnp.abs(rings.logs)
        hidden = jax.nn.silu(r[..., None] * p["input"][0] + shift)
        g = jax.nn.silu(hidden @ p["hidden"] + p["bias"])
        e = (rings.logs / jnp.where(r > 0, r, 1))[..., None]
        s = jnp.real(y * jnp.conj(y))
        powers = y, s * jax.lax.rsqrt(s + SMOOTHING) * e, jnp.conj(y) * e**2
        channels = [weights * powers[m] * g[..., h, None] for h, m in enumerate((0, 0, 0, 1, 1, 1, 2, 2))]
        response = jnp.stack(channels, -1)
    summed = jnp.moveaxis(response.sum(1), -1, 1).reshape(x.shape[0], -1)
    return summed @ jax.lax.complex(p["output"][0], p["output"][1])


@pytest.mark.slow
@pytest.mark.parametrize("level", ["fine", "coarse"])
@pytest.mark.parametrize("filter", FILTERS)
def test_scatter_free_gradients_are_those_of_autodiff(filter, level):
    rings = getattr(OPEN, level)
    count = len(rings.masses)
    arguments = field(count), parameters_of(filter), embedding_of(count)
    target = field(count, D, seed=5)

    def loss(conv):
        return lambda *a: jnp.sum(jnp.abs(conv(rings, *a, filter) - target) ** 2)

    ours, theirs = (jax.jit(jax.grad(loss(conv), (0, 1, 2)))(*arguments) for conv in (field_conv, plain_conv))
    assert relative(ours[0], theirs[0]) < 1e-4
    assert relative(ours[2], theirs[2]) < 1e-4
    for name in theirs[1]:
        assert relative(ours[1][name], theirs[1][name]) < 1e-4, name


@pytest.mark.slow
@pytest.mark.parametrize("filter", FILTERS)
def test_no_scatter_in_the_compiled_gradient(filter):
    rings, count = OPEN.fine, len(OPEN.fine.masses)

    def loss(x, parameters, embedding, conv):
        return jnp.sum(jnp.abs(conv(rings, x, parameters, embedding, filter)) ** 2)

    def program(conv) -> str:
        gradient = jax.jit(jax.grad(loss, (0, 1, 2)), static_argnums=3)
        return gradient.lower(field(count), parameters_of(filter), embedding_of(count), conv).as_text()

    assert "stablehlo.scatter" not in program(field_conv)
    assert "stablehlo.scatter" in program(plain_conv)  # the word is the right one


@pytest.mark.slow
@pytest.mark.parametrize("filter", FILTERS)
def test_copies_in_a_batch_do_not_see_each_other(filter):
    rings = jax.tree.map(lambda *a: jnp.stack(a), OPEN.fine, OPEN.fine)
    x = jnp.stack([field(36, seed=1), field(36, seed=2)])
    embedding, parameters = jnp.ones(E), parameters_of(filter)

    def loss(parameters, rings, x):
        return jnp.sum(jnp.abs(field_conv(rings, x, parameters, embedding, filter)) ** 2)

    def batch(parameters):
        return jnp.sum(jax.vmap(loss, (None, 0, 0))(parameters, rings, x))

    together = jax.grad(batch)(parameters)
    one, two = (jax.grad(loss)(parameters, OPEN.fine, x[i]) for i in (0, 1))
    for name in together:
        assert relative(together[name], one[name] + two[name]) < 1e-4, name


@pytest.mark.slow
@pytest.mark.parametrize("filter", FILTERS)
def test_initial_filters_keep_the_size_of_noise(filter):
    rings, x = tables_of(icosphere(2)).fine, tangent_noise(jax.random.key(0), (162, 64))

    def gain(key):
        y = field_conv(rings, x, init_filter(key, 64, 64, filter=filter), None, filter)
        return jnp.mean(jnp.abs(y) ** 2) / jnp.mean(jnp.abs(x) ** 2)

    gains = jax.vmap(gain)(jax.random.split(jax.random.key(1), 32))
    assert 0.7 < float(jnp.sqrt(jnp.mean(gains))) < 1.4


def test_the_embedding_is_read_at_the_neighbour():
    rings, parameters = SPHERE.fine, parameters_of("harmonic")
    x, quiet = field(len(rings.masses)), jnp.zeros((len(rings.masses), E))
    for filter in FILTERS:
        parameters = parameters_of(filter)
        change = field_conv(rings, x, parameters, quiet.at[0].set(1.0), filter)
        change = jnp.abs(change - field_conv(rings, x, parameters, quiet, filter)).max(1) > 1e-5
        assert set(np.flatnonzero(change)) == set(np.asarray(rings.neighbors[0])) | {0}


# --- pooling ----------------------------------------------------------------------------------------------


def test_pooling_and_unpooling_turn_with_the_frames():
    alpha = np.random.default_rng(0).uniform(0, 2 * np.pi, len(TORUS.fine.masses))
    turn = np.exp(1j * alpha)[:, None].astype(np.complex64)
    below = turn[np.asarray(TORUS.pooling.centers)]
    x, y = field(len(turn)), field(len(below), seed=1)
    other = turned(TORUS, alpha).pooling
    assert relative(pool(other, turn * x), below * pool(TORUS.pooling, x)) < 1e-5
    assert relative(unpool(other, below * y), turn * unpool(TORUS.pooling, y)) < 1e-5


def test_pooling_then_unpooling_keeps_parallel_fields():
    # On a flat square the field of a constant direction is parallel: e^{-i angle of each frame}, that is,
    # what transport makes of one vector. Along each ring the frames are related by the transports.
    rings = OPEN.fine
    parallel = np.zeros(len(rings.masses), np.complex64)
    parallel[0] = 1.0
    neighbors, transports = np.asarray(rings.neighbors), np.asarray(rings.transports)
    for _ in range(20):
        for q in np.flatnonzero(parallel):
            for p, k in zip(neighbors[q], np.asarray(rings.reverse)[q], strict=True):
                parallel[p] = transports[p, k] * parallel[q]
    assert np.allclose(np.abs(parallel), 1, atol=1e-4)
    x = jnp.asarray(parallel[:, None])
    assert relative(unpool(OPEN.pooling, pool(OPEN.pooling, x)), x) < 1e-4
    # It is no identity: other fields change.
    assert relative(unpool(OPEN.pooling, pool(OPEN.pooling, field(36))), field(36)) > 0.1


def test_unpooling_then_pooling_is_the_identity():
    y = field(len(SPHERE.coarse.masses))
    assert relative(pool(SPHERE.pooling, unpool(SPHERE.pooling, y)), y) < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("surface", SURFACES)
def test_pooling_gradients_are_those_of_autodiff(surface):
    tables = SURFACES[surface]
    p = tables.pooling

    def plain_pool(p: Pooling, x):
        return jnp.sum((p.child_weights * p.child_transports)[..., None] * x[p.children], 1)

    def plain_unpool(p: Pooling, y):
        return jnp.conj(p.transports)[:, None] * y[p.parents]

    fine, coarse = field(len(tables.fine.masses)), field(len(tables.coarse.masses), seed=2)
    for ours, theirs, x, target in ((pool, plain_pool, fine, coarse), (unpool, plain_unpool, coarse, fine)):

        def loss(f, x, target=target):
            return jnp.sum(jnp.abs(f(p, x) - target) ** 2)

        assert relative(ours(p, x), theirs(p, x)) < 1e-6
        assert relative(jax.grad(loss, 1)(ours, x), jax.grad(loss, 1)(theirs, x)) < 1e-5
        program = jax.jit(jax.grad(loss, 1), static_argnums=0).lower(ours, x).as_text()
        assert "stablehlo.scatter" not in program


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"filter": "mlp"}, "not those of filter='mlp'; use filter='harmonic'"),
        ({"x": field(4, 3)}, "x has 3 channels, but the parameters are for 2"),
        ({"x": jnp.zeros((4, 2))}, "x is float32; give complex numbers"),
        ({"embedding": jnp.zeros(5)}, "the parameters take no embedding"),
    ],
)
def test_what_does_not_belong_to_the_parameters_is_refused(changed, message):
    bank = init_filter(jax.random.key(0), channels=2, features=3)
    given = {"x": field(4, 2), "embedding": None, "filter": "harmonic"}
    _check(parameters=bank, **given)
    with pytest.raises(ValueError, match=re.escape(message)):
        _check(parameters=bank, **given | changed)
