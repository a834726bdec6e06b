"""Encoded images → pixels: 8-bit RGB, and alpha beside it; and back, as PNG.

Decoded at once, never lazily, and not before the number of pixels in the header is known to be bearable.
Formats are named one by one: Pillow knows some (EPS) that start other programs.
"""

import io
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from flx.assets.formats.files import BadFile, limit

FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TGA", "TIFF")
REFUSED = {
    b"\xabKTX": "KTX2",
    b"DDS ": "DDS",
    b"sB": "Basis",
    b"#?RADIANCE": "HDR",
    b"\x76\x2f\x31\x01": "EXR",
}
TIFF_BITS, TIFF_PLANES = 258, 284  # tags
KINDS = {"RGBA": "RGB", "L": "grey", "LA": "grey", "I;16": "grey", "1": "black and white", "P": "palette"}


def open_image(content: bytes, name: str) -> Image.Image:
    """The image behind its header, not yet decoded.

    Raises BadFile for a format that is not read here, and for more than `FLX_MAX_PIXELS`.
    """
    for magic, kind in REFUSED.items():
        if content.startswith(magic):
            raise BadFile(f"image {name!r} is {kind}; save it as PNG or JPEG")
    Image.MAX_IMAGE_PIXELS = most = limit("FLX_MAX_PIXELS")  # Pillow's own error comes at twice as many
    remedy = "reduce it to 8192 × 8192, or set FLX_MAX_PIXELS"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            image = Image.open(io.BytesIO(content), formats=FORMATS)
    except Image.DecompressionBombError as fault:
        raise BadFile(f"image {name!r} has more than {2 * most:,} pixels; {remedy}") from fault
    except (OSError, SyntaxError, ValueError, OverflowError) as fault:
        raise BadFile(f"image {name!r} is of no known kind; save it as PNG or JPEG") from fault
    if image.width * image.height > most:
        raise BadFile(
            f"image {name!r} has {image.width} × {image.height} pixels, more than {most:,}; {remedy}"
        )
    return image


def decode_image(content: bytes, name: str) -> tuple[UInt8[Any, "H W 3"], UInt8[Any, "H W"] | None]:
    """8-bit RGB, and alpha where it says anything. 16-bit grey is scaled, never clipped.

    Raises BadFile as `open_image` does, and for what Pillow cannot decode.
    """
    image = open_image(content, name)
    tags = getattr(image, "tag_v2", {})
    if tags.get(TIFF_PLANES) == 2 and max(tags.get(TIFF_BITS, (8,))) > 8:  # Pillow reads them as 8 bits
        raise BadFile(f"image {name!r} is a TIFF of 16-bit planes; save it as PNG")
    try:
        image.load()
    except Exception as fault:  # a decoder may raise anything
        told = " ".join(str(fault).split())[:80]
        raise BadFile(f"image {name!r} is broken ({told}); save it again") from fault
    if image.mode.startswith("I"):
        image = Image.fromarray(np.rint(np.asarray(image) / 257).clip(0, 255).astype(np.uint8))
    elif image.mode == "F":
        raise BadFile(f"image {name!r} holds floating point numbers; save it as 8-bit PNG")
    alpha = None
    if image.has_transparency_data:
        image = image.convert("RGBA")
        alpha = np.asarray(image)[..., 3].copy()
        alpha = None if (alpha == 255).all() else alpha
    return np.array(image.convert("RGB")), alpha


def told_of(content: bytes, name: str) -> str:
    """What an image has that 8-bit RGB (and alpha, which is kept) has not: "" or, say, "16-bit grey"."""
    image = open_image(content, name)
    bits = "16-bit " if ";16" in str(getattr(image, "tile", "")) else ""
    kind = KINDS.get(image.mode, image.mode)
    return "" if f"{bits}{kind}" == "RGB" else f"{bits}{kind}"


def encode_png(image: UInt8[Any, "_ _ 3"], alpha: UInt8[Any, "_ _"] | None) -> bytes:
    """A PNG; `alpha`, of any size, makes it RGBA."""
    picture = Image.fromarray(image)
    if alpha is not None:
        picture.putalpha(Image.fromarray(alpha).resize(picture.size, Image.Resampling.BILINEAR))
    content = io.BytesIO()
    picture.save(content, format="PNG")
    return content.getvalue()


def check_together(contents: Mapping[str, bytes]) -> None:
    """Raises BadFile where images of one mesh have more than four times `FLX_MAX_PIXELS`."""
    pixels = sum(image.width * image.height for image in (open_image(c, n) for n, c in contents.items()))
    if pixels > (most := 4 * limit("FLX_MAX_PIXELS")):
        raise BadFile(
            f"{len(contents)} images have {pixels:,} pixels, more than {most:,}; reduce them, "
            f"or set FLX_MAX_PIXELS={-(-pixels // 4)}"
        )
