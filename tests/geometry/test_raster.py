"""Law of scan conversion: the pixels on one side of all edges, and no others."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from flx.geometry.raster import pixels_inside


def inside(triangle: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The oracle: on one side of all three edges."""
    sides = [
        (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])
        for a, b in zip(triangle, np.roll(triangle, -1, 0), strict=True)
    ]
    return (np.min(sides, 0) >= 0) | (np.max(sides, 0) <= 0)


@given(st.integers(0, 10_000), st.booleans())
def test_scan_conversion_finds_the_pixels_on_one_side_of_all_edges(seed, whole_numbers):
    rng = np.random.default_rng(seed)
    triangle = rng.uniform(-12, 12, (3, 2))
    if whole_numbers:  # centres on edges and corners
        triangle = np.round(triangle)
    edges = triangle[1:] - triangle[0]
    y, x = np.mgrid[-13:14, -13:14]
    flat = abs(np.linalg.det(edges)) < 1e-12
    expected = set() if flat else set(zip(x[inside(triangle, x, y)], y[inside(triangle, x, y)], strict=True))
    found = [
        (column, row)
        for chunk in pixels_inside(triangle[None])
        for column, row in zip(chunk.columns, chunk.rows, strict=True)
    ]
    assert len(found) == len(set(found))
    assert set(found) == expected
