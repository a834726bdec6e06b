"""Fields and tables in other frames, and with spare room."""

import jax
import jax.numpy as jnp
import numpy as np

from flx.fields.algebra import tangent_noise
from flx.geometry.tables import mesh_tables
from flx.types import MeshTables, OneRings, Pooling


def tables_of(triangulation) -> MeshTables:
    return jax.tree.map(jnp.asarray, mesh_tables(triangulation))


def field(vertices: int, channels: int = 5, seed: int = 0):
    return tangent_noise(jax.random.key(seed), (vertices, channels))


def relative(a, b) -> float:
    a, b = np.asarray(a), np.asarray(b)
    assert np.abs(b).max() > 1e-3, "a comparison with zero says nothing"
    return float(np.abs(a - b).max() / np.abs(b).max())


def turned(tables: MeshTables, alpha: np.ndarray) -> MeshTables:
    """The same surface with the frame of each vertex p turned by −α_p, so that vectors turn by e^{iα_p}."""
    turn = np.exp(1j * alpha)

    def rings(r: OneRings, turn: np.ndarray) -> OneRings:
        there = turn[np.asarray(r.neighbors)]
        logs, carried = r.logs * turn[:, None], r.transports * turn[:, None] * there.conj()
        return r._replace(logs=logs.astype(r.logs.dtype), transports=carried.astype(r.logs.dtype))

    p = tables.pooling
    at_center = turn[np.asarray(p.centers)]
    pooling = p._replace(
        transports=(p.transports * at_center[np.asarray(p.parents)] * turn.conj()).astype(p.transports.dtype),
        child_transports=(
            p.child_transports * at_center[:, None] * turn[np.asarray(p.children)].conj()
        ).astype(p.transports.dtype),
    )
    return MeshTables(rings(tables.fine, turn), pooling, rings(tables.coarse, at_center))


def renumbered(tables: MeshTables, fine: np.ndarray, coarse: np.ndarray) -> MeshTables:
    """The same surface with the rows of both levels in another order: new row i is old row order[i]."""
    fine_place, coarse_place = np.argsort(fine), np.argsort(coarse)

    def rings(r: OneRings, order: np.ndarray, place: np.ndarray) -> OneRings:
        return OneRings(place[r.neighbors[order]].astype(np.int32), *(a[order] for a in r[1:]))

    p = tables.pooling
    pooling = Pooling(
        fine_place[p.centers[coarse]].astype(np.int32),
        coarse_place[p.parents[fine]].astype(np.int32),
        p.transports[fine],
        fine_place[p.children[coarse]].astype(np.int32),
        *(a[coarse] for a in p[4:]),
    )
    return MeshTables(
        rings(tables.fine, fine, fine_place), pooling, rings(tables.coarse, coarse, coarse_place)
    )


def padded(rings: OneRings, slots: int = 2, vertices: int = 3) -> OneRings:
    """Spare slots and spare vertices, as the conventions ask for them."""
    count, width = rings.neighbors.shape

    def grow(a, spare):
        a = np.asarray(a)
        a = np.concatenate([a, np.full((count, slots), spare, a.dtype)], 1)
        return np.concatenate([a, np.full((vertices, width + slots), spare, a.dtype)], 0)

    neighbors, reverse = grow(rings.neighbors, 0), grow(rings.reverse, 0)
    neighbors[:count, width:] = np.arange(count)[:, None]
    neighbors[count:] = np.arange(count, count + vertices)[:, None]
    reverse[:count, width:] = np.arange(width, width + slots)
    reverse[count:] = np.arange(width + slots)
    arrays = neighbors, reverse, grow(rings.logs, 0), grow(rings.transports, 1), grow(rings.weights, 0)
    return OneRings(*map(jnp.asarray, arrays), jnp.pad(rings.masses, (0, vertices)))


def fields(vertices: int, channels: int = 6) -> tuple[jax.Array, jax.Array]:
    return tuple(tangent_noise(jax.random.key(k), (vertices, channels)) for k in (0, 1))  # type: ignore


def as_complex(pairs: jax.Array) -> jax.Array:
    return jax.lax.complex(*jnp.split(pairs, 2, -1))


def frames(vertices: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(-np.pi, np.pi, vertices)


def turn_of(alpha: np.ndarray) -> jax.Array:
    return jnp.asarray(np.exp(1j * alpha), jnp.complex64)[:, None]
