"""Colours: linear light, sRGB, 8 bits."""

from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Num, UInt8


def srgb(linear: Num[Any, "..."]) -> Float64[Any, "..."]:
    """Linear light to sRGB, [0, 1] (IEC 61966-2-1)."""
    x = np.clip(np.asarray(linear, np.float64), 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def linear(color: Num[Any, "..."]) -> Float64[Any, "..."]:
    """sRGB to linear light, [0, 1]: the inverse of `srgb`."""
    x = np.clip(np.asarray(color, np.float64), 0, 1)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def quantized(colors: Float32[Any, "P 3"]) -> UInt8[Any, "P 3"]:
    """Colours as a texture holds them: clipped to [0, 1], 8 bits."""
    return np.rint(np.clip(colors, 0, 1) * 255).astype(np.uint8)
