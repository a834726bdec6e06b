"""What gather tables do to fields, in plain NumPy."""

import numpy as np
import pytest
from helpers.surfaces import bump, uneven_sphere, uneven_torus

from flx.types import MeshTables, OneRings, Pooling

surfaces = pytest.mark.parametrize("surface", [uneven_sphere, uneven_torus, bump])
SLOTS = 24


def ring_mean(rings: OneRings, field: np.ndarray) -> np.ndarray:
    """What every convolution does: transport, weigh, sum."""
    return (rings.weights * rings.transports * field[rings.neighbors]).sum(axis=1)


def pool(pooling: Pooling, field: np.ndarray) -> np.ndarray:
    return (pooling.child_weights * pooling.child_transports * field[pooling.children]).sum(axis=1)


def unpool(pooling: Pooling, field: np.ndarray) -> np.ndarray:
    return pooling.transports.conj() * field[pooling.parents]


def in_use(rings: OneRings) -> np.ndarray:
    """Real neighbours: every slot of positive weight but the first."""
    used = rings.weights > 0
    used[:, 0] = False
    return used


def assert_same_tables(actual: MeshTables, expected: MeshTables, atol: float = 0.0) -> None:
    for level, other in zip(actual, expected, strict=True):
        for name, array in level._asdict().items():
            wanted = getattr(other, name)
            assert array.dtype == wanted.dtype
            np.testing.assert_allclose(array, wanted, rtol=0, atol=atol, err_msg=name)
