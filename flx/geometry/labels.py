"""Labels of a surface: each flat colour of an image on its UVs, or of its corners, is one label.

Labels are numbers from 0 in the order of their colours, red before green before blue, so that every picture
of the same colours numbers them alike. A triangulated copy gets them by the closest points of its surface.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int, Int32, UInt8
from scipy.ndimage import maximum_filter, minimum_filter

from flx.geometry.arrays import face_areas
from flx.geometry.atlas import atlas_texels, fill_gutter
from flx.geometry.color import quantized
from flx.geometry.sampling import transfer
from flx.types import SurfacePoints, TexturedMesh, Triangulation

MOST = 32  # labels; an image with more flat colours is not one of labels
SMALLEST = 1e-4  # share of the texels that a flat colour must fill: less is noise of an encoder
FLAT = 0.5  # share of the texels that have one of the flat colours; the rest may be borders
CLOSE = 8  # levels of 255 by which a colour may differ from the learnt one: programs manage colours

# Where a face is looked at: the middles of its four quarters.
_QUARTERS = np.array([(2, 2, 2), (4, 1, 1), (1, 4, 1), (1, 1, 4)]) / 6

Palette = UInt8[Any, "L 3"]  # the colours of labels 0, 1, …, in their order


class LabelMap(NamedTuple):
    """A label at every point of a surface."""

    mesh: TexturedMesh  # where the points are, and its UVs
    palette: Palette
    numbers: Int32[Any, "_ _"]  # labels of texels [H, W]; without textures, of corners of faces [F, 3]

    def at(self, points: SurfacePoints) -> Int32[Any, "P"]:
        """The labels of points: that of their texel, or of the nearest corner."""
        if not self.mesh.textures:
            return self.numbers[points.faces, points.barycentrics.argmax(1)]
        uvs = np.einsum("pkx,pk->px", self.mesh.corner_uvs[points.faces], points.barycentrics)
        height, width = self.numbers.shape
        columns, rows = np.floor(uvs * [width, height]).astype(np.int64).T
        return self.numbers[rows % height, columns % width]


def image_labels(mesh: TexturedMesh, image: UInt8[Any, "H W 3"], palette: Palette | None = None) -> LabelMap:
    """The labels that an image of flat colours gives a surface by its UVs, whatever its textures are.

    A colour is flat where a texel and its eight neighbours have it. Other texels are borders that a program
    smoothed: of the flat colours that are at most two texels away they get the most similar, and farther off
    the nearest. Only texels that the surface shows count, at any size of the image.

    Args:
        palette: The labels to find, if they are given; those of the image otherwise.

    Raises ValueError for an image that is not one of flat colours, has too many or too few, or has one that
    is not in the palette.
    """
    mesh = mesh.with_layer(images=(image,), face_images=np.zeros(len(mesh.faces), np.int64))
    covered, codes = atlas_texels(mesh, 0, *image.shape[:2]).covered, _codes(image)
    flat = covered & (minimum_filter(codes, 3) == maximum_filter(codes, 3))
    found, counts = np.unique(codes[flat], return_counts=True)
    found = found[counts >= max(SMALLEST * covered.sum(), 2)]  # faces without UVs show one texel
    # All neighbours of a flat texel have its colour. Elsewhere, a mixture may be like a third label.
    known = covered & maximum_filter(flat & np.isin(codes, found), 3)
    if known.sum() < FLAT * covered.sum():
        raise ValueError(
            f"only {known.sum() / max(covered.sum(), 1):.0%} of its texels have a flat colour; paint regions "
            "of one colour each, without gradients, and save it as PNG"
        )
    colors, numbers = _numbered(found, palette)
    sharp, certain = _with_sharp_borders(image, known, covered)
    codes = _codes(fill_gutter(sharp, certain))
    return LabelMap(mesh, colors, numbers[np.searchsorted(found, codes)])


def _with_sharp_borders(
    image: UInt8[Any, "H W 3"], known: Bool[Any, "H W"], covered: Bool[Any, "H W"]
) -> tuple[UInt8[Any, "H W 3"], Bool[Any, "H W"]]:
    """The image in which mixed texels have the most similar known colour that is at most two texels away, and
    where it now is certain."""
    (rows, columns), sharp = np.nonzero(covered & ~known), image.copy()
    own, least = image[rows, columns].astype(np.int32), np.full(len(rows), np.inf)
    for down, right in np.argwhere(np.ones((5, 5))) - 2:
        y = np.clip(rows + down, 0, image.shape[0] - 1)
        x = np.clip(columns + right, 0, image.shape[1] - 1)
        away = np.where(known[y, x], np.square(image[y, x] - own).sum(1), np.inf)
        nearer = away < least
        sharp[rows[nearer], columns[nearer]] = image[y, x][nearer]
        least[nearer] = away[nearer]
    certain = known.copy()
    certain[rows, columns] = np.isfinite(least)
    return sharp, certain


def corner_labels(mesh: TexturedMesh, palette: Palette | None = None) -> LabelMap:
    """The labels that the colours of its corners give a surface without textures.

    Raises ValueError as `image_labels` does.
    """
    found, which = np.unique(_codes(quantized(mesh.corner_colors)), return_inverse=True)
    colors, numbers = _numbered(found, palette)
    return LabelMap(mesh, colors, numbers[which.reshape(-1, 3)])


def labels_on(labels: LabelMap, triangulation: Triangulation) -> Int32[Any, "V"]:
    """The label of each vertex of another triangulation of the surface: what fills most of its one-ring.

    Four points of each face look up the closest point that faces the same way. Equal shares go to the lower
    label. Nothing depends on how the copy is numbered.
    """
    vertices, faces = triangulation
    places = SurfacePoints(np.repeat(np.arange(len(faces)), 4), np.tile(_QUARTERS, (len(faces), 1)))
    seen = labels.at(transfer(places, triangulation, labels.mesh)).reshape(-1, 4)
    count, areas = len(labels.palette), face_areas(vertices, faces)
    places_of = faces[:, :, None] * count + seen[:, None, :]  # face, corner, quarter
    weights = np.broadcast_to(areas[:, None, None], places_of.shape)
    votes = np.bincount(places_of.ravel(), weights.ravel(), len(vertices) * count).reshape(-1, count)
    votes = votes / np.maximum(votes.sum(1, keepdims=True), np.finfo(float).tiny)
    return np.round(votes, 9).argmax(1).astype(np.int32)  # rounded: the order of a sum decides no tie


def shares(numbers: Int32[Any, "V"], masses: Float64[Any, "V"], count: int) -> Float64[Any, "L"]:
    """The share of the surface that each label has."""
    return np.bincount(numbers, masses, count) / masses.sum()


def hexadecimal(color: UInt8[Any, "3"]) -> str:
    """A colour as painting programs write it: #ff8800."""
    return "#" + "".join(f"{level:02x}" for level in color)


def _codes(colors: UInt8[Any, "*N 3"]) -> Int[Any, "*N"]:
    """Each colour as one number, in the order of labels."""
    red, green, blue = np.moveaxis(colors.astype(np.int32), -1, 0)
    return red << 16 | green << 8 | blue


def _colors(codes: Int[Any, "L"]) -> Palette:
    return np.stack([codes >> 16, codes >> 8 & 255, codes & 255], -1).astype(np.uint8)


def _numbered(found: Int[Any, "N"], palette: Palette | None) -> tuple[Palette, Int32[Any, "N"]]:
    """A palette, and the label of each colour that was found. Raises ValueError for colours beyond it."""
    colors = _colors(found)
    if palette is None:
        if len(found) > MOST:
            raise ValueError(f"it has {len(found)} flat colours, more than {MOST}; merge some of its regions")
        if len(found) < 2:
            raise ValueError(f"it has {len(found)} flat colour; paint at least two regions")
        return colors, np.arange(len(found), dtype=np.int32)
    away = np.abs(colors[:, None].astype(int) - palette).max(2)
    odd = away.min(1, initial=256) > CLOSE
    if odd.any():
        color, nearest = colors[odd][0], palette[np.argsort(away[odd][0], kind="stable")[:3]]
        raise ValueError(
            f"colour {hexadecimal(color)} was never learnt; the nearest labels that were are "
            f"{', '.join(map(hexadecimal, nearest))}: paint with those"
        )
    return palette, away.argmin(1).astype(np.int32)
