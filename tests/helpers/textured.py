"""Textured surfaces: charts of one face each, and a square."""

import numpy as np

from flx.types import Layer, TexturedMesh, Triangulation


def textured(triangulation: Triangulation, uvs: np.ndarray, *textures: np.ndarray) -> TexturedMesh:
    count = len(triangulation.faces)
    none = np.zeros(count, np.int64)
    return TexturedMesh(
        *triangulation, {"base_color": Layer(textures, none, uvs)}, np.zeros((count, 3, 3), np.float32)
    )


def separate_charts(triangulation: Triangulation, cells: int, fill: float = 0.8) -> np.ndarray:
    """Every face its own little chart in a grid: nothing but seams."""
    number = np.arange(len(triangulation.faces))
    assert len(number) <= cells * cells
    low = np.stack([number % cells, number // cells], -1)[:, None] + 0.1
    return (low + fill * np.array([(0, 0), (1, 0), (0, 1.0)])) / cells


def noise(height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)


def quad(uvs: list[tuple[float, float]]) -> TexturedMesh:
    """The unit square; uvs of (0, 0), (1, 0), (1, 1), (0, 1)."""
    vertices = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0.0)])
    faces = np.array([(0, 1, 2), (0, 2, 3)])
    return textured(Triangulation(vertices, faces), np.array(uvs, float)[faces])
