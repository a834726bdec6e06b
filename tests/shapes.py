"""Surfaces that tests share: small, exact, one for each topology."""

import numpy as np
from scipy.spatial import ConvexHull

from flx.types import Triangulation

_PHI = (1 + 5**0.5) / 2
_CORNERS = (
    """-1 φ 0  1 φ 0  -1 -φ 0  1 -φ 0  0 -1 φ  0 1 φ  0 -1 -φ  0 1 -φ  φ 0 -1  φ 0 1  -φ 0 -1  -φ 0 1"""
)
_FACES = """
    0 11 5   0 5 1   0 1 7   0 7 10  0 10 11  1 5 9   5 11 4  11 10 2  10 7 6  7 1 8
    3 9 4    3 4 2   3 2 6   3 6 8   3 8 9    4 9 5   2 4 11  6 2 10   8 6 7   9 8 1"""


def icosphere(subdivisions: int) -> Triangulation:
    """A unit sphere of 10·4ⁿ + 2 vertices: 12, 42, 162, 642, 2,562."""
    vertices = np.array([float(a) for a in _CORNERS.replace("φ", str(_PHI)).split()]).reshape(-1, 3)
    faces = np.array([int(a) for a in _FACES.split()]).reshape(-1, 3)
    vertices = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    for _ in range(subdivisions):
        corners = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        edges, which = np.unique(np.sort(corners, 1), axis=0, return_inverse=True)
        middles = vertices[edges].sum(1)
        ab, bc, ca = which.reshape(-1, 3).T + len(vertices)
        a, b, c = faces.T
        vertices = np.concatenate([vertices, middles / np.linalg.norm(middles, axis=1, keepdims=True)])
        quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        faces = np.concatenate([np.stack(q, 1) for q in quarters])
    return Triangulation(vertices, faces)


def torus(around: int = 24, across: int = 12, radius: float = 1.0, tube: float = 0.4) -> Triangulation:
    """A closed surface of genus one, `around`·`across` vertices of degree six."""
    u, v = np.meshgrid(np.arange(around), np.arange(across), indexing="ij")
    theta, phi = 2 * np.pi * u / around, 2 * np.pi * v / across
    ring = radius + tube * np.cos(phi)
    vertices = np.stack([ring * np.cos(theta), ring * np.sin(theta), tube * np.sin(phi)], -1).reshape(-1, 3)

    def index(i: np.ndarray, j: np.ndarray) -> np.ndarray:
        return ((i % around) * across + j % across).ravel()

    a, b, c, d = index(u, v), index(u + 1, v), index(u + 1, v + 1), index(u, v + 1)
    return Triangulation(vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))


def square_grid(side: int) -> Triangulation:
    """The flat unit square of `side`² vertices, seen from +z: an open surface, its frames all parallel."""
    steps = np.linspace(0.0, 1.0, side)
    x, y = np.meshgrid(steps, steps, indexing="ij")
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(side * side)], 1)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(side - 1), np.arange(side - 1), indexing="ij"))
    a, b, c, d = i * side + j, (i + 1) * side + j, (i + 1) * side + j + 1, i * side + j + 1
    return Triangulation(vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))


def tetrahedron() -> Triangulation:
    """Four vertices of degree three."""
    vertices = np.array([(1.0, 1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, 1.0)])
    return Triangulation(vertices, np.array([(0, 1, 2), (0, 3, 1), (0, 2, 3), (1, 3, 2)]))


def random_sphere(count: int, seed: int = 0) -> Triangulation:
    """The convex hull of `count` random points of the unit sphere, facing outwards."""
    points = np.random.default_rng(seed).normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    faces = ConvexHull(points).simplices.astype(np.int64)
    a, b, c = (points[faces[:, k]] for k in range(3))
    outwards = a - points.mean(0)  # of the hull's inside; few points may all lie to one side of the origin
    inward = (np.cross(b - a, c - a) * outwards).sum(1) < 0
    faces[inward] = faces[inward][:, ::-1]
    return Triangulation(points, faces)
