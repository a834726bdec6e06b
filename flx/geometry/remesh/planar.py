"""Random triangulations of a planar rectangle, used to train the FL-VAE."""

import numpy as np
from scipy.spatial import Delaunay

from flx.geometry.arrays import Rng, sum_at
from flx.types import Triangulation


def planar(count: int, size: tuple[float, float], rng: Rng, irregularity: float = 0.3) -> Triangulation:
    """A random Delaunay triangulation of the rectangle [0, w] x [0, h] at z = 0, with `count` vertices.

    `irregularity` is the share of points that are uniform at random instead of relaxed (Lloyd's algorithm):
    0 gives nearly equilateral faces, 1 a uniform point set. The paper's farthest-point samples lie between.
    Takes about 15 ms for 1,000 vertices.

    Raises ValueError if `count` < 4, `size` is not positive or `irregularity` is outside [0, 1].
    """
    if count < 4 or min(size) <= 0 or not 0 <= irregularity <= 1:
        raise ValueError(
            f"no triangulation of {count} vertices, size {size}, irregularity {irregularity}; "
            "give at least 4 vertices, positive sides and an irregularity from 0 to 1"
        )
    border = _border(count, size, rng, irregularity)
    points = np.concatenate([border, rng.uniform((0, 0), size, (count - len(border), 2))])
    scattered = points.copy()
    for _ in range(4):
        faces, area = _delaunay(points)
        pull = sum_at(faces, area[:, None] * points[faces].mean(1), count)
        points[len(border) :] = (pull / sum_at(faces, area[:, None], count))[len(border) :]
    random = (np.arange(count) >= len(border)) & (rng.random(count) < irregularity)
    points[random] = scattered[random]
    return Triangulation(np.concatenate([points, np.zeros((count, 1))], 1), _delaunay(points)[0])


def _delaunay(points):
    """Faces (counter-clockwise, as SciPy returns them) and areas, without flat faces along the sides."""
    faces = np.asarray(Delaunay(points).simplices, np.int64)
    u, v = points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]]
    area = (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2
    solid = area > 1e-12 * area.sum()
    return faces[solid], area[solid]


def _border(count, size, rng, irregularity):
    """The corners of the rectangle and points on its sides, with the spacing of `count` points inside."""
    (width, height) = size
    spacing = np.sqrt(2 * width * height / (np.sqrt(3) * count))
    limit = 0.5 * (count - 4) * spacing / (2 * (width + height))  # at most half of the points lie on sides
    points = [np.array([[0, 0], [width, 0], [width, height], [0, height]], float)]
    for axis, side in ((0, 0.0), (1, width), (0, height), (1, 0.0)):
        number = int(min(1.0, limit) * size[axis] / spacing)
        even = np.arange(1, number + 1) / (number + 1)
        along = (even + irregularity * (rng.random(number) - 0.5) * 0.8 / (number + 1)) * size[axis]
        other = np.full(number, side)
        points.append(np.stack([along, other] if axis == 0 else [other, along], 1))
    return np.concatenate(points)
