"""Decodes images to RGB of 8 bits (or 16, for maps) and 8-bit alpha, and encodes them as PNG.

The number of pixels in the header is checked before anything is decoded. Formats are listed one by one:
Pillow knows some (EPS) that start other programs.

EXIF data of a photograph may say that it is to be turned. Viewers disagree about that in textures: Blender
and trimesh take the pixels as they are stored, browsers turn them. Here they are as stored, and `is_turned`
tells. Only those of a TIFF, whose own tag it is, are turned, by Pillow.
"""

import io
import struct
import warnings
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import UInt, UInt8, UInt16
from PIL import ExifTags, Image

from flx.assets.formats.files import BadFile, limit

FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TGA", "TIFF")
REFUSED = {
    **{b"\xabKTX": "KTX2", b"DDS ": "DDS", b"sB": "Basis"},
    **{b"#?RADIANCE": "HDR", b"\x76\x2f\x31\x01": "EXR"},
}
TIFF_BITS, TIFF_PLANES = 258, 284  # tags
KINDS = {"RGBA": "RGB", "L": "grey", "LA": "grey", "I;16": "grey", "1": "black and white", "P": "palette"}


def open_image(content: bytes, name: str) -> Image.Image:
    """The image, not yet decoded.

    Raises BadFile for a format that is not supported, and for more than `FLX_MAX_PIXELS`.
    """
    for magic, kind in REFUSED.items():
        if content.startswith(magic):
            raise BadFile(f"image {name!r} is {kind}; save it as PNG or JPEG")
    most, previous = limit("FLX_MAX_PIXELS"), Image.MAX_IMAGE_PIXELS
    remedy = "reduce it to 8192 × 8192, or set FLX_MAX_PIXELS"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            Image.MAX_IMAGE_PIXELS = most  # Pillow's own error comes at twice as many
            image = Image.open(io.BytesIO(content), formats=FORMATS)
    except Image.DecompressionBombError as fault:
        raise BadFile(f"image {name!r} has more than {2 * most:,} pixels; {remedy}") from fault
    except (OSError, SyntaxError, ValueError, OverflowError) as fault:
        raise BadFile(f"image {name!r} is of no known kind; save it as PNG or JPEG") from fault
    finally:
        Image.MAX_IMAGE_PIXELS = previous
    if image.width * image.height > most:
        size = f"{image.width} × {image.height} pixels"
        raise BadFile(f"image {name!r} has {size}, more than {most:,}; {remedy}")
    return image


def decode_image(content: bytes, name: str) -> tuple[UInt8[Any, "H W 3"], UInt8[Any, "H W"] | None]:
    """8-bit RGB, and alpha unless it is opaque everywhere. 16-bit grey is scaled, not clipped.

    Raises BadFile as `open_image` does, and for an image that Pillow cannot decode.
    """
    image = open_image(content, name)
    tags = getattr(image, "tag_v2", {})
    if tags.get(TIFF_PLANES) == 2 and max(tags.get(TIFF_BITS, (8,))) > 8:  # Pillow reads them as 8 bits
        raise BadFile(f"image {name!r} is a TIFF of 16-bit planes; save it as PNG")
    try:
        image.load()
    except Exception as fault:  # a decoder may raise anything
        reason = " ".join(str(fault).split())[:80]
        raise BadFile(f"image {name!r} is broken ({reason}); save it again") from fault
    if image.mode.startswith("I"):
        image = Image.fromarray(np.rint(np.asarray(image) / 257).clip(0, 255).astype(np.uint8))
    elif image.mode == "F":
        raise BadFile(f"image {name!r} holds floating point numbers; save it as 8-bit PNG")
    if image.has_transparency_data:
        return split_alpha(np.array(image.convert("RGBA")))
    return np.array(image.convert("RGB")), None


def split_alpha(pixels: UInt8[Any, "H W C"]) -> tuple[UInt8[Any, "H W 3"], UInt8[Any, "H W"] | None]:
    """RGB, and alpha unless there is none or it is opaque everywhere."""
    rgb, alpha = pixels[..., :3].copy(), pixels[..., 3:].copy()
    return rgb, None if (alpha == 255).all() else alpha[..., 0]


def decode_map(content: bytes, name: str) -> tuple[UInt[Any, "H W 3"], UInt8[Any, "H W"] | None]:
    """As `decode_image`, but the 16 bits of a PNG stay 16.

    Pillow keeps only the high byte of 16-bit RGB; with the byte order swapped, it keeps the low one.
    """
    pixels, alpha = decode_image(content, name)
    image = open_image(content, name)
    layout = str(image.tile[0].args) if image.format == "PNG" and image.tile else ""  # pyright: ignore
    if layout in ("RGB;16B", "RGBA;16B"):
        image.tile = [tile._replace(args=f"{layout[:-1]}L") for tile in image.tile]  # pyright: ignore
        return pixels.astype(np.uint16) << 8 | np.asarray(image)[..., :3], alpha
    if layout.startswith("I;16"):
        return np.repeat(np.asarray(image).astype(np.uint16)[..., None], 3, 2), alpha
    return pixels, alpha


def bits_of(image: Image.Image) -> int:
    """Bits per channel, 8 or 16, of an image that is not decoded yet."""
    return 16 if ";16" in str(getattr(image, "tile", "")) else 8


def original_kind(content: bytes, name: str) -> str:
    """The image's kind before conversion, such as "16-bit grey"; "" if it was 8-bit RGB or RGBA."""
    image = open_image(content, name)
    bits = "16-bit " if bits_of(image) == 16 else ""
    kind = KINDS.get(image.mode, image.mode)
    return "" if f"{bits}{kind}" == "RGB" else f"{bits}{kind}"


def is_turned(content: bytes, name: str) -> bool:
    """Whether EXIF data say that the stored pixels are turned or mirrored."""
    try:
        image = open_image(content, name)
        turned = image.getexif().get(ExifTags.Base.Orientation, 1) in range(2, 9)
        return turned and image.format != "TIFF"
    except BadFile:
        raise
    except Exception:  # EXIF data may be broken in any way, and are not needed
        return False


def encode_png(image: UInt[Any, "_ _ 3"], alpha: UInt8[Any, "_ _"] | None) -> bytes:
    """A PNG of as many bits as the image has; `alpha`, of any size, makes it RGBA."""
    size = image.shape[1::-1]
    mask = None if alpha is None else Image.fromarray(alpha).resize(size, Image.Resampling.BILINEAR)
    if image.dtype == np.uint16:
        more = [] if mask is None else [np.asarray(mask).astype(np.uint16)[..., None] * 257]
        return _deep_png(np.concatenate([image, *more], 2))
    picture = Image.fromarray(image)
    if mask is not None:
        picture.putalpha(mask)
    content = io.BytesIO()
    picture.save(content, format="PNG")
    return content.getvalue()


def _deep_png(image: UInt16[Any, "H W C"]) -> bytes:
    """A 16-bit PNG of three or four channels, which Pillow cannot write. Rows are differences of pixels."""
    height, width, channels = image.shape
    rows = image.astype(">u2").view(np.uint8).reshape(height, width, -1)
    steps = np.diff(rows, axis=1, prepend=np.zeros_like(rows[:, :1])).reshape(height, -1)
    lines = np.concatenate([np.ones((height, 1), np.uint8), steps], 1)
    header = struct.pack(">IIBBBBB", width, height, 16, {3: 2, 4: 6}[channels], 0, 0, 0)
    png = b"\x89PNG\r\n\x1a\n"
    for kind, body in ((b"IHDR", header), (b"IDAT", zlib.compress(lines.tobytes())), (b"IEND", b"")):
        png += struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    return png


def check_together(contents: Mapping[str, bytes]) -> None:
    """Raises BadFile where images of one mesh have more than four times `FLX_MAX_PIXELS`."""
    images = [open_image(content, name) for name, content in contents.items()]
    pixels = sum(image.width * image.height for image in images)
    if pixels > (most := 4 * limit("FLX_MAX_PIXELS")):
        remedy = f"reduce them, or set FLX_MAX_PIXELS={-(-pixels // 4)}"
        raise BadFile(f"{len(images)} images have {pixels:,} pixels, more than {most:,}; {remedy}")
