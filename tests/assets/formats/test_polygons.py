"""Laws of cutting polygons: every triangle faces the polygon's way, and together they cover it once."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import special_ortho_group

from flx.assets.formats.polygons import cut_polygons, fans


def star(radii: list[float], seed: int) -> np.ndarray:
    """A polygon around the origin, turned in space."""
    turns = 2 * np.pi * np.arange(len(radii)) / len(radii)
    flat = np.array(radii)[:, None] * np.stack([np.cos(turns), np.sin(turns), 0 * turns], 1)
    return flat @ special_ortho_group.rvs(3, random_state=seed).T


def areas(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    a, b, c = points[triangles.T]
    return np.cross(b - a, c - a) / 2


@given(
    st.lists(st.lists(st.floats(0.05, 1), min_size=3, max_size=12), min_size=1, max_size=5),
    st.integers(0, 99),
)
def test_triangles_face_the_way_of_their_polygon_and_cover_it_once(polygons, seed):
    points = np.concatenate([star(radii, seed + i) for i, radii in enumerate(polygons)])
    sizes = np.array(list(map(len, polygons)))
    triangles, owners = cut_polygons(sizes, points)
    found, fan = areas(points, triangles), areas(points, fans(sizes)[0])
    assert (owners == fans(sizes)[1]).all()
    for polygon, radii in enumerate(polygons):
        whole = fan[owners == polygon].sum(0)
        pieces = np.linalg.norm(found[owners == polygon], axis=1)
        assert pieces.sum() == pytest.approx(np.linalg.norm(whole), rel=1e-6)
        corners = triangles[owners == polygon]
        assert len(np.unique(corners)) == len(radii) and (corners >= sizes[:polygon].sum()).all()


def test_where_a_fan_covers_a_polygon_it_is_kept():
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.1]])
    assert cut_polygons(np.array([4]), square)[0].tolist() == [[0, 1, 2], [0, 2, 3]]
    dart = np.array([[1.0, 1, 0], [1, 4, 0], [0, 0, 0], [4, 1, 0]])  # concave, but seen from its notch
    assert cut_polygons(np.array([4]), dart)[0].tolist() == [[0, 1, 2], [0, 2, 3]]


def test_many_polygons_and_large_ones_are_cut_in_bounded_time():
    """Beyond the bounds they become fans."""
    sizes = np.array([2000, 5, *[40] * 20_000])
    radii = [1, 0.2] * 400_000
    points = np.concatenate([star(radii[:size], 0) for size in (2000, 5, 40)])
    points = np.concatenate([points, np.tile(points[-40:], (19_999, 1))])
    triangles = cut_polygons(sizes, points)[0]
    assert len(triangles) == (sizes - 2).sum()
    assert (triangles[:1998] == fans(sizes)[0][:1998]).all()
    pieces = areas(points, triangles[1998:2001])
    assert np.linalg.norm(pieces, axis=1).sum() == pytest.approx(np.linalg.norm(pieces.sum(0)))
