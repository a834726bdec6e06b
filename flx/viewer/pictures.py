"""The images of a page: made small one by one, then encoded so that all of them fit into its bytes."""

import io
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import UInt, UInt8
from PIL import Image

from flx.geometry.color import resized

LARGEST = 1024  # pixels on the longer side
MASTER = 95  # JPEG quality that images wait in until the page is written
# Pixels on the longer side and JPEG quality, best first.
RUNGS = ((1024, 88), (1024, 78), (768, 78), (512, 78), (384, 75), (256, 75), (128, 70))


class Fit(NamedTuple):
    """Images of all paintings at one size and quality."""

    images: list[list[bytes]]  # JPEG
    longest: int
    quality: int


def master(image: UInt[Any, "_ _ 3"]) -> bytes:
    """A JPEG of at most 1024 pixels on the longer side, to wait in: large textures need not be held."""
    pixels = np.right_shift(image, 8).astype(np.uint8) if image.dtype == np.uint16 else image
    return jpeg(at_most(pixels, LARGEST), MASTER)


def jpeg(image: UInt8[Any, "_ _ 3"], quality: int) -> bytes:
    content = io.BytesIO()
    Image.fromarray(image).save(content, "JPEG", quality=quality, subsampling=0)
    return content.getvalue()


def fitted(masters: Sequence[Sequence[bytes]], room: int) -> Fit | None:
    """The images of each painting at the best size and quality at which all take at most `room` bytes.

    Images that several paintings share count once. None where even the smallest take more.
    """
    distinct = list(dict.fromkeys(content for images in masters for content in images))
    for longest, quality in RUNGS:
        encoded = _encode(distinct, longest, quality, room)
        if encoded is not None:
            known = dict(zip(distinct, encoded, strict=True))
            return Fit([[known[content] for content in images] for images in masters], longest, quality)
    return None


def _encode(masters: Sequence[bytes], longest: int, quality: int, room: int) -> list[bytes] | None:
    """The images at a size and quality; None as soon as they take more than `room` bytes."""
    encoded = []
    for content in masters:
        pixels = np.asarray(Image.open(io.BytesIO(content), formats=["JPEG"]))
        encoded.append(jpeg(at_most(pixels, longest), quality))
        room -= len(encoded[-1])
        if room < 0:
            return None
    return encoded


def alpha_png(alpha: UInt8[Any, "H W"]) -> bytes:
    """The alpha of an image, as a grey PNG. All paintings share it, so it is in the page once."""
    picture, content = Image.fromarray(alpha), io.BytesIO()
    picture.thumbnail((LARGEST, LARGEST), Image.Resampling.BOX)
    picture.save(content, "PNG")
    return content.getvalue()


def at_most(image: UInt8[Any, "_ _ 3"], longest: int) -> UInt8[Any, "_ _ 3"]:
    height, width = image.shape[:2]
    share = min(1.0, longest / max(height, width))
    return resized(image, max(1, round(height * share)), max(1, round(width * share)))
