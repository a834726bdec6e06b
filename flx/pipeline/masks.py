"""Masks: what of a texture is kept, and what of it is damaged.

Nothing is learnt from damage: codes are those of the intact colours around it, the loss does not count
vertices that see it, and no piece is taken from there.
"""

import hashlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from flx.assets.asset import Asset
from flx.assets.formats.files import read_file
from flx.assets.formats.images import decode_image
from flx.controls import Controls
from flx.geometry.arrays import mark
from flx.geometry.atlas import atlas_texels, fill_gutter
from flx.geometry.color import resized
from flx.geometry.sampling import transfer
from flx.types import TexturedMesh, Triangulation


class Kept(NamedTuple):
    """What is kept of the one texture that an asset has."""

    image: UInt8[np.ndarray, "H W 3"]
    index: int  # of the image among the mesh's
    texels: Bool[np.ndarray, "H W"]

    def at_size(self, height: int, width: int) -> "Kept":
        """At another size: the mean of what a texel covers, which is kept where all of it is."""
        shares = resized(np.uint8(255) * np.repeat(self.texels[..., None], 3, 2), height, width)
        return Kept(resized(self.image, height, width), self.index, shares[..., 0] == 255)


def kept_texels(asset: Asset, controls: Controls) -> Kept | None:
    """What controls keep of an asset; None where they keep nothing.

    Of a mask, what is at least half white and half opaque counts as white. Raises ValueError for an asset
    without exactly one texture, and for a mask that is not an image of its size.
    """
    path = controls.keep or controls.fill
    if path is None:
        return None
    painted = [index for index, texture in enumerate(asset.textures) if not texture.flat]
    if len(painted) != 1:
        raise ValueError(f"{asset.path} has {len(painted)} textures; --keep and --fill need exactly one")
    image = asset.mesh.textures[painted[0]]
    white = read_mask(path, image.shape[:2])
    texels = white if controls.keep else ~white
    return Kept(image, painted[0], texels) if texels.any() else None


def read_mask(path: Path, size: tuple[int, ...]) -> Bool[np.ndarray, "H W"]:
    """Where an image is white. Raises ValueError for a file that is not an image of this height and width."""
    try:
        pixels, alpha = decode_image(read_file(path), path.name)
    except FileNotFoundError:
        raise ValueError(f"mask {path} does not exist; paint one on a copy of the texture") from None
    if pixels.shape[:2] != size:
        (height, width), (tall, wide) = pixels.shape[:2], size
        raise ValueError(
            f"mask {path} has {width} × {height} pixels but the texture {wide} × {tall}; make them equal"
        )
    white = pixels.mean(2) >= 128
    return white if alpha is None else white & (alpha >= 128)


def continued(mesh: TexturedMesh, kept: Kept) -> TexturedMesh:
    """The surface with the nearest kept colours where nothing is kept: no code tells what was there."""
    images = list(mesh.textures)
    images[kept.index] = fill_gutter(kept.image, kept.texels & _shown(mesh, kept))
    return mesh.with_layer(images=tuple(images))


def marked(mesh: TexturedMesh, *parts: Kept) -> TexturedMesh:
    """The surface in black, white where one of the parts does not keep it."""
    images = [np.zeros_like(image) for image in mesh.textures]
    for part in parts:
        images[part.index][~part.texels] = 255
    return mesh.with_layer(images=tuple(images))


# --- damage


def read_damage(path: Path, asset: Asset) -> Kept:
    """What is intact of an asset's one texture, by a mask that is white where it is damaged.

    Raises ValueError as `kept_texels` does, and where nothing of the surface is intact.
    """
    intact = kept_texels(asset, Controls(fill=path))
    if intact is None or not (intact.texels & _shown(asset.mesh, intact)).any():
        raise ValueError(f"mask {path} is white all over: nothing is left to learn; mark damage alone")
    return intact


def without_damage(asset: Asset, intact: Kept | None) -> Asset:
    """The asset with the nearest intact colours where it is damaged."""
    if intact is None:
        return asset
    digest = hashlib.sha256(asset.digest.encode() + intact.texels.tobytes()).hexdigest()
    return asset._replace(mesh=continued(asset.mesh, intact), digest=digest)


def intact_masses(
    mesh: TexturedMesh, intact: Kept, triangulation: Triangulation, masses: Float32[Any, "V"]
) -> Float32[np.ndarray, "V"]:
    """Masses of vertices, 0 where a one-ring meets damage; they sum to 1.

    Raises ValueError where every one-ring does.
    """
    atlas = atlas_texels(mesh, intact.index, *intact.texels.shape)
    points = atlas.points_at(np.flatnonzero(atlas.covered & ~intact.texels))
    faces = transfer(points, mesh, triangulation).faces
    left = np.where(mark(len(masses), triangulation.faces[faces]), 0, masses)
    if not left.any():
        raise ValueError("every one-ring meets damage; mark less of it, or raise --surface.vertices")
    return (left / left.sum()).astype(np.float32)


def _shown(mesh: TexturedMesh, kept: Kept) -> Bool[Any, "H W"]:
    """The texels that show the surface."""
    return atlas_texels(mesh, kept.index, *kept.texels.shape).covered
