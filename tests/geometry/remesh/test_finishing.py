"""Laws of the last passes: sharp corners widen, and nothing else moves."""

import igl
import numpy as np
import pytest
from helpers.oracles import mean_edge, pairs_of
from helpers.surfaces import random_sphere
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from flx.geometry.remesh import finishing
from flx.geometry.remesh.finishing import SHARP_COSINE, widen_angles
from flx.geometry.remesh.planar import planar
from flx.geometry.remesh.smoothing import ReferenceSurface
from flx.geometry.remesh.stars import sharpest_cosines
from flx.geometry.topology import all_of
from flx.types import Triangulation

seeds = st.integers(0, 10**6)


def worst_at(mesh: Triangulation) -> np.ndarray:
    """The sharpest corner's cosine in the faces around each vertex."""
    worst = np.full(len(mesh.vertices), -1.0)
    np.maximum.at(worst, mesh.faces.ravel(), sharpest_cosines(*mesh).repeat(3))
    return worst


@settings(max_examples=8)
@given(seeds)
def test_a_vertex_moves_only_where_its_sharpest_corner_widens(seed):
    mesh = random_sphere(150, seed)
    surface = ReferenceSurface(*mesh, mean_edge(mesh))
    pinned = np.random.default_rng(seed).random(150) < 0.3
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(finishing, "TRIES", 1)
        patch.setattr(finishing, "MOST_TRIES", 1)
        after = widen_angles(mesh, pinned, surface, np.random.default_rng(seed))
    moved = (after.vertices != mesh.vertices).any(1)
    assert moved.sum() > 3 and not moved[pinned].any()
    before = worst_at(mesh)
    assert (worst_at(after) < before)[moved].all() and (before > SHARP_COSINE)[moved].all()
    assert not all_of(moved, pairs_of(mesh)).any()
    assert surface.distances(after.vertices).max() < 1e-12
    np.testing.assert_array_equal(after.faces, mesh.faces)


@settings(max_examples=5)
@given(seeds)
def test_angles_widen_and_corners_of_the_boundary_stay(seed):
    mesh = planar(150, (1.0, 1.0), np.random.default_rng(seed), 0.0)
    after = widen_angles(
        mesh, np.zeros(150, bool), ReferenceSurface(*mesh, mean_edge(mesh)), np.random.default_rng(seed)
    )
    before, sharp = sharpest_cosines(*mesh), sharpest_cosines(*after)
    assume(before.max() < finishing.NARROW_COSINE)  # corners give way to needles
    assert sharp.max() <= before.max() and (sharp > SHARP_COSINE).sum() < 0.7 * (before > SHARP_COSINE).sum()
    np.testing.assert_array_equal(after.vertices[:4], mesh.vertices[:4])
    assert igl.doublearea(*after).min() > 0 and igl.doublearea(*after).sum() == pytest.approx(2, rel=1e-12)
