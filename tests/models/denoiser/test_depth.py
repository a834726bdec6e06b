"""Laws of how deep a network is, and how far a vertex sees through it."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.denoisers import denoiser
from helpers.frames import field, tables_of
from helpers.surfaces import icosphere

from flx.config import FLDM, FLVAE
from flx.models.denoiser.depth import blocks_for, complete, reach
from flx.types import MeshTables, OneRings


@pytest.mark.parametrize(
    ("vertices", "blocks"),
    [(2_562, (1, 1, 1)), (5_000, (1, 1, 2)), (10_000, (2, 2, 2)), (30_000, (2, 4, 4))],
)
def test_depth_follows_from_the_vertex_count(vertices, blocks):
    assert blocks_for(vertices) == blocks


def test_more_vertices_never_make_a_shallower_network():
    depths = [blocks_for(n) for n in range(100, 60_000, 100)]
    assert depths[0] == (1, 1, 1) and depths[-1] == (2, 4, 4)
    for shallow, deep in itertools.pairwise(depths):
        assert all(a <= b for a, b in zip(shallow, deep, strict=True))


def test_a_model_has_a_vector_condition_where_there_is_a_direction():
    assert complete(FLDM(), FLVAE(), 5000).directions == 0
    for asked in (0, 1):
        assert complete(FLDM(directions=asked), FLVAE(), 5000, directions=1).directions == 1
    with pytest.raises(ValueError, match=r"model.directions is 1 but there are 0; leave it out"):
        complete(FLDM(directions=1), FLVAE(), 5000)


@pytest.mark.slow
def test_reach_is_where_the_gradient_is_not_zero():
    tables, blocks, z = tables_of(icosphere(3)), (1, 1, 1), field(642, 3)
    apply, params = denoiser("harmonic", conditions=0)

    # The norms see every vertex through one mean a channel: weighting it by nothing cuts that path.
    blind = MeshTables(*(t._replace(masses=t.masses * 0) if isinstance(t, OneRings) else t for t in tables))

    @jax.jit
    def seen(source):
        def output(z):
            return jnp.sum(jnp.abs(apply(params, blind, z, jnp.float32(1.0))[source]))

        return jnp.mean(jnp.abs(jax.grad(output)(z)).max(1) > 0)

    share = reach(tables, blocks, sources=4)
    sources = np.linspace(0, 641, 4).astype(int)
    assert share == pytest.approx(np.mean([seen(s) for s in sources]), rel=0.03)
    assert 0.05 < share < 0.9


def test_reach_grows_with_depth():
    tables = tables_of(icosphere(3))
    shares = [reach(tables, b) for b in ((1, 1, 1), (1, 1, 2), (1, 2, 2), (2, 2, 2))]
    assert shares == sorted(shares) and 0 < shares[0] < shares[-1] <= 1
