"""Textures made from the input to read the judge by: blurred, without structure, shuffled, another one."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from scipy.ndimage import gaussian_filter
from scipy.spatial import KDTree

from flx.evaluation.charts import place_charts
from flx.geometry.arrays import face_areas
from flx.geometry.atlas import atlas_texels, fill_gutter
from flx.geometry.color import quantized, resized
from flx.geometry.geodesics import unfold
from flx.geometry.sampling import positions, surface_colors
from flx.types import TexturedMesh

SIZE = 1024  # pixels on the longer side of a control, at most
TILE = 0.01  # of the area, in a shuffled tile
TILES = 300


def controls(mesh: TexturedMesh, seed: int) -> dict[str, TexturedMesh]:
    """The controls by name; none for a mesh that has colours at its vertices only.

    - blur: the input without details of an eighth of the radius of a 1 % chart and less.
    - shuffled: tiles of the input from random places, in random turns.
    - noise: the input's colours, each at random.
    - checks: boxes in space in two of the input's colours.
    """
    if not mesh.textures:
        return {}
    rng, unfolding = np.random.default_rng(seed), unfold(mesh.vertices, mesh.faces)
    radius = float(np.sqrt(TILE * face_areas(mesh.vertices, mesh.faces).sum() / np.pi))
    images = [_shrunk(image) for image in mesh.textures]
    mesh = mesh.with_layer(images=tuple(images))
    atlases = [atlas_texels(mesh, n, *image.shape[:2]) for n, image in enumerate(images)]
    palette = np.concatenate([image[a.covered] for image, a in zip(images, atlases, strict=True)])
    sigma = 0.125 * np.sqrt(TILE / np.pi * len(palette))  # texels

    def blurred(n: int) -> UInt8[Any, "H W 3"]:
        filled = fill_gutter(images[n], atlases[n].covered, 4 * sigma).astype(np.float32)
        return quantized(gaussian_filter(filled, (sigma, sigma, 0)) / 255)

    target, source = (place_charts(mesh, unfolding, TILE, TILES, rng) for _ in range(2))
    seeds = KDTree(positions(mesh.vertices, mesh.faces, target.centers))
    places = positions(mesh.vertices, mesh.faces, target.points).reshape(TILES, -1, 3)
    colors = surface_colors(mesh, source.points).reshape(*places.shape)

    def shuffled(at: Float64[Any, "P 3"]) -> Float32[Any, "P 3"]:
        tile, result = seeds.query(at)[1], np.empty(at.shape, np.float32)
        for k in np.unique(tile):
            inside = tile == k
            result[inside] = colors[k, KDTree(places[k]).query(at[inside])[1]]
        return result

    two = palette[np.argsort(palette.sum(1))[[len(palette) // 10, -1 - len(palette) // 10]]] / np.float32(255)

    def painted(paint: Callable[[Any], Any]) -> TexturedMesh:
        new = [image.copy() for image in images]
        for image, atlas in zip(new, atlases, strict=True):
            image[atlas.covered] = quantized(paint(positions(mesh.vertices, mesh.faces, atlas.points)))
            image[:] = fill_gutter(image, atlas.covered)
        return mesh.with_layer(images=tuple(new))

    return {
        "blur": mesh.with_layer(images=tuple(blurred(n) for n in range(len(images)))),
        "shuffled": painted(shuffled),
        "noise": painted(lambda at: rng.choice(palette, len(at)) / np.float32(255)),
        "checks": painted(lambda at: two[np.floor(at / radius).astype(int).sum(1) % 2]),
    }


def _shrunk(image: UInt8[Any, "H W 3"]) -> UInt8[Any, "h w 3"]:
    factor = min(1.0, SIZE / max(image.shape[:2]))
    return resized(image, *(max(1, round(side * factor)) for side in image.shape[:2]))
