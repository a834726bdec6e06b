"""A thin board whose front has two charts that meet at x = 0, with a blue disc across that seam."""

from functools import cache

import numpy as np
from helpers.surfaces import box

from flx.assets.arrays import from_arrays
from flx.assets.asset import Asset
from flx.geometry.atlas import Atlas, atlas_texels
from flx.geometry.sampling import positions

EXTENTS = 1.6, 1.0, 0.03
SIDE = 256  # of its texture
DISC, BOARD = (40, 90, 200), (200, 180, 160)


@cache
def slab() -> Asset:
    """Seven charts in a grid of four by two: the two of the front first, the back third."""
    board = box(*EXTENTS)
    corners = board.vertices[board.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    axes = np.abs(normals).argmax(1)
    above = np.take_along_axis(normals, axes[:, None], 1)[:, 0] > 0
    front = (axes == 2) & above
    chart = np.where(front, corners.mean(1)[:, 0] > 0, 2 + 2 * (2 - axes) - (axes < 2) + above)
    share = corners / EXTENTS + 0.5
    share[front, :, 0] = 2 * share[front, :, 0] - chart[front, None]
    along = np.array([(1, 2), (0, 2), (0, 1)])[axes]
    inside = 0.05 + 0.9 * np.take_along_axis(share, along[:, None], 2)
    uvs = (inside + np.stack([chart % 4, chart // 4], 1)[:, None]) / [4, 2]
    blank = from_arrays(*board, uvs, np.full((SIDE, SIDE, 3), BOARD, np.uint8))
    image = np.full((SIDE, SIDE, 3), BOARD, np.uint8)
    places, atlas = texel_places(blank)
    disc = (places[:, 2] > 0.014) & (np.hypot(places[:, 0], places[:, 1]) < 0.25)
    image.reshape(-1, 3)[atlas.texels[disc]] = DISC
    return from_arrays(*board, uvs, image)


def texel_places(asset: Asset, side: int = SIDE) -> tuple[np.ndarray, Atlas]:
    """The point of the surface that each covered texel shows, and the atlas."""
    atlas = atlas_texels(asset.mesh, 0, side, side)
    return positions(asset.mesh.vertices, asset.mesh.faces, atlas.points), atlas
