"""Laws of random triangulations of a rectangle."""

import igl
import numpy as np
import pytest
from helpers.oracles import coincidence, min_angles
from hypothesis import given
from hypothesis import strategies as st

from flx.geometry.remesh.planar import planar
from flx.types import Triangulation


@given(
    st.integers(4, 600),
    st.tuples(st.floats(0.1, 10), st.floats(0.1, 10)),
    st.floats(0, 1),
    st.integers(0, 2**32 - 1),
)
def test_planar_triangulations_cover_the_rectangle_once(count, size, irregularity, seed):
    mesh = planar(count, size, np.random.default_rng(seed), irregularity)
    assert len(mesh.vertices) == count and len(np.unique(mesh.faces)) == count
    assert np.all(mesh.vertices[:, 2] == 0)
    a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    area = np.cross(b - a, c - a)[:, 2] / 2
    assert area.min() > 0  # counter-clockwise
    assert area.sum() == pytest.approx(size[0] * size[1], rel=1e-9)
    assert np.allclose(mesh.vertices[:, :2].min(0), 0) and np.allclose(mesh.vertices[:, :2].max(0), size)
    assert len(igl.boundary_loop_all(mesh.faces)) == 1 and igl.euler_characteristic(mesh.faces) == 1


def test_irregularity_lowers_angles_and_seeds_differ():
    even, mixed, wild = (
        planar(1000, (2.0, 1.0), np.random.default_rng(0), irregularity) for irregularity in (0.0, 0.5, 1.0)
    )
    means = [min_angles(mesh).mean() for mesh in (even, mixed, wild)]
    assert means[0] > 42 > means[1] > 34 > means[2]
    again, other = (planar(1000, (2.0, 1.0), np.random.default_rng(seed), 0.0) for seed in (0, 1))
    assert again.vertices.tobytes() == even.vertices.tobytes()
    inner = Triangulation(other.vertices, other.faces)
    assert coincidence(even, inner) < 0.2  # its evenly spaced border is shared
    with pytest.raises(ValueError, match="at least 4"):
        planar(3, (1.0, 1.0), np.random.default_rng(0))
