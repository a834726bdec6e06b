"""How much of a texture a number of vertices keeps: an estimate, from means over blocks of its texels.

A vertex of the released FL-VAE keeps about as much as nine blocks do. Against `flx reconstruct` at 2,500 to
20,000 vertices: within 3 dB on two scans; a painted, smooth texture is kept 4 to 7 dB better than estimated.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64, Int

from flx.assets.asset import Asset
from flx.geometry.color import resized

BLOCKS = (2, 4, 8, 16, 32)  # texels on a side
CELLS = 9.0  # blocks that a vertex is worth
LEAST = 1e-8  # a squared error that is rounding
BEYOND = 20.0  # how far the curve goes on, a factor e each
Detail = Sequence[tuple[float, float]]  # number of blocks, and the squared error of their means; finest first


def detail(asset: Asset, counts: dict[int, Int[Any, "_ _"]]) -> Detail:
    """What the means of ever larger blocks miss of the textures; `counts` are those of `texel_counts`.

    Empty where nothing is painted, or all is of one colour.
    """
    images = []
    for index, counted in counts.items():
        colors = resized(asset.mesh.textures[index], *counted.shape)
        images.append((colors.astype(np.float32) / 255, (counted > 0).astype(np.float32)[..., None]))
    found = []
    for side in BLOCKS:
        errors = texels = 0.0
        for image, shown in (pair for pair in images if side <= min(pair[0].shape[:2])):
            inside, colors = _blocks(shown, side), _blocks(image, side)
            weights = inside.sum(1, keepdims=True)
            means = (colors * inside).sum(1, keepdims=True) / np.maximum(weights, 1)
            errors += float((np.square(colors - means) * inside).sum()) / 3
            texels += float(weights.sum())
        if errors > LEAST * texels:
            found.append((texels / side**2, errors / texels))
    return found


def psnr_at(found: Detail, vertices: float | int) -> float:
    """The PSNR at which so many vertices keep the textures, about, in dB."""
    cells, levels = _curve(found)
    return float(np.interp(np.log(CELLS * vertices), cells, levels))


def vertices_for(found: Detail, psnr: float | int) -> float:
    """With how many vertices the textures are kept at this PSNR."""
    cells, levels = _curve(found)
    return float(np.exp(np.interp(psnr, levels, cells))) / CELLS


def _curve(found: Detail) -> tuple[Float64[Any, "N"], Float64[Any, "N"]]:
    """Logarithms of numbers of blocks, ascending, and their PSNR.

    Beyond the finest and the coarsest, errors are taken to fall as the number of blocks grows, or faster.
    """
    cells, errors = np.array(found[::-1]).T
    cells, levels = np.log(cells), -10 * np.log10(errors)
    levels = np.maximum.accumulate(levels + 1e-6 * np.arange(len(levels)))
    slopes = np.diff(levels) / np.diff(cells)
    last = max(slopes[-1:].max(initial=0.0), 10 / np.log(10))
    ends = (levels[0] - BEYOND * 10 / np.log(10), levels[-1] + BEYOND * last)
    cells = np.array([cells[0] - BEYOND, *cells, cells[-1] + BEYOND])
    return cells, np.array([ends[0], *levels, ends[1]])


def _blocks(values: np.ndarray, side: int) -> np.ndarray:
    """[H, W, C] as [blocks, side², C]; what is left at the right and at the bottom is dropped."""
    height, width = (length // side for length in values.shape[:2])
    cut = values[: height * side, : width * side].reshape(height, side, width, side, -1)
    return cut.transpose(0, 2, 1, 3, 4).reshape(height * width, side * side, -1)
