"""Colours and images: sRGB and linear light, depths of 8 and 16 bits, sizes."""

from typing import Any

import numpy as np
from jaxtyping import Float, Float64, Num, UInt, UInt8
from numpy.typing import DTypeLike
from PIL import Image


def srgb(linear: Num[Any, "..."]) -> Float64[Any, "..."]:
    """Linear light to sRGB, both in [0, 1] (IEC 61966-2-1)."""
    x = np.clip(np.asarray(linear, np.float64), 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def linear(color: Num[Any, "..."]) -> Float64[Any, "..."]:
    """The inverse of `srgb`."""
    x = np.clip(np.asarray(color, np.float64), 0, 1)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def quantized(colors: Float[Any, "*N"], dtype: DTypeLike = np.uint8) -> UInt[Any, "*N"]:
    """Colours, clipped to [0, 1], as integers of 8 or 16 bits."""
    return np.rint(np.clip(colors, 0, 1) * np.iinfo(dtype).max).astype(dtype)


def eight_bits(image: UInt[Any, "H W 3"]) -> UInt8[Any, "H W 3"]:
    """An image of 8 or 16 bits in 8 bits."""
    return image if image.dtype == np.uint8 else quantized(image / np.iinfo(image.dtype).max)


def resized(image: UInt8[Any, "H W 3"], height: int, width: int) -> UInt8[Any, "_ _ 3"]:
    """The image at another size, each pixel the mean of the area that it covers."""
    if image.shape[:2] == (height, width):
        return image
    return np.asarray(Image.fromarray(image).resize((width, height), Image.Resampling.BOX))
