"""Laws of the sums over one-rings that vectors and invariants share."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.frames import as_complex, fields, frames, padded, relative, tables_of, turn_of, turned
from helpers.surfaces import square_grid, torus

from flx.fields import stencils as pairwise
from flx.fields.algebra import real_pairs
from flx.fields.stencils import of_rings, ring_sums

VECTORS, INVARIANTS = [0, 1, 2], [3, 4]  # of the stencils' outputs


def stencils(rings, x: jax.Array, t: jax.Array) -> list[jax.Array]:
    """The stencils of complex fields."""
    return [as_complex(y) for y in pairwise.stencils(of_rings(rings), real_pairs(x), real_pairs(t))]


@pytest.mark.parametrize(
    "surface",
    [torus(), pytest.param(square_grid(9), marks=pytest.mark.slow)],
    ids=["torus", "sheet"],
)
def test_stencils_turn_as_their_order_says(surface):
    tables = tables_of(surface)
    x, t = fields(len(surface.vertices))
    alpha = frames(len(x))
    here, there = stencils(tables.fine, x, t), stencils(turned(tables, alpha).fine, x * turn_of(alpha), t)
    for n in VECTORS:
        assert relative(there[n], here[n] * turn_of(alpha)) < 1e-5
    for n in INVARIANTS:
        assert relative(there[n], here[n]) < 1e-5


def test_stencils_of_linear_and_parallel_fields_on_a_flat_sheet():
    """Constants have no gradient, parallel fields no divergence; a linear field's gradient is its slope."""
    sheet = square_grid(9)
    rings = tables_of(sheet).fine
    inside = np.all(np.abs(sheet.vertices[:, :2] - 0.5) < 0.3, axis=1)  # equal masses all around
    # The sheet's frames are all parallel but turned by the direction of each ring's first edge.
    edge = sheet.vertices[np.asarray(rings.neighbors[:, 1])] - sheet.vertices
    first = edge[:, 0] + 1j * edge[:, 1]
    frame = first / np.abs(first) / (np.asarray(rings.logs[:, 1]) / np.abs(rings.logs[:, 1]))
    ones = jnp.ones((len(frame), 1), jnp.complex64)
    parallel = jnp.asarray(np.conj(frame), jnp.complex64)[:, None] * (0.3 + 0.8j)
    mean, _, gradient, smooth, divergence = stencils(rings, parallel, ones)
    np.testing.assert_allclose(mean, parallel, atol=1e-5)
    np.testing.assert_allclose(smooth, 1, atol=1e-5)
    np.testing.assert_allclose(np.asarray(gradient)[inside], 0, atol=1e-5)
    np.testing.assert_allclose(np.asarray(divergence)[inside], 0, atol=1e-5)

    slope = jnp.asarray(sheet.vertices[:, :1] * 2 + sheet.vertices[:, 1:2], jnp.complex64)
    found = np.asarray(stencils(rings, parallel, slope)[2])[inside, 0] * frame[inside]
    np.testing.assert_allclose(found, found[0], atol=1e-5)  # everywhere the same vector in space
    assert abs(found[0]) > 0.01 and abs(np.angle(found[0] / (2 + 1j))) < 0.4


@pytest.mark.slow
def test_scatter_free_gradients_are_those_of_autodiff():
    rings = tables_of(torus()).fine
    level = of_rings(rings)
    vectors, invariants = (real_pairs(f) for f in fields(rings.neighbors.shape[0]))
    x = (vectors, vectors, invariants, invariants, vectors)

    def plain(x: tuple) -> list:
        gathered = [as_complex(f)[rings.neighbors] for f in x]
        return [real_pairs(jnp.einsum("vk,vkc->vc", c, f)) for c, f in zip(level.sent, gathered, strict=True)]

    def energy(function):
        return lambda x: sum(jnp.sum((y - 0.3) ** 2) for y in function(x))

    summed = lambda x: ring_sums(level, x)  # noqa: E731
    for a, b in zip(summed(x), plain(x), strict=True):
        assert relative(a, b) < 1e-5
    for a, b in zip(jax.grad(energy(summed))(x), jax.grad(energy(plain))(x), strict=True):
        assert relative(a, b) < 1e-4


@pytest.mark.slow
def test_padding_is_inert():
    rings = tables_of(torus()).fine
    x, t = fields(rings.neighbors.shape[0])
    spare = tuple(jnp.pad(f, ((0, 3), (0, 0)), constant_values=9) for f in (x, t))
    there = stencils(padded(rings), *spare)
    for a, b in zip(there, stencils(rings, x, t), strict=True):
        assert relative(a[: len(x)], b) < 1e-6
