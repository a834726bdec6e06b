"""Random pages of flat colours, hard edges and letters, as on packages and signs; photographs have few."""

import string
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

SUPERSAMPLING = 2  # pages are drawn this many times larger, then averaged, for smooth edges
MARKS = 60  # shapes and words per page


def printed_pages(count: int, side: int, seed: int) -> UInt8[Any, "N H W 3"]:
    """Random pages of side² pixels, or none; the same seed gives the same pages."""
    pages = np.zeros((count, side, side, 3), np.uint8)
    for k in range(count):
        page = _page(np.random.default_rng([seed, k]), side * SUPERSAMPLING)
        pages[k] = np.asarray(page.resize((side, side), Image.Resampling.BOX))
    return pages


def _page(rng: np.random.Generator, side: int) -> Image.Image:
    inks = [_ink(rng) for _ in range(5)]
    page = Image.new("RGB", (side, side), inks[0])
    draw = ImageDraw.Draw(page)
    for _ in range(MARKS):
        ink = inks[rng.integers(len(inks))]
        x, y = rng.uniform(-0.1, 1, 2) * side
        size = side * np.exp(rng.uniform(np.log(0.02), np.log(0.4)))
        kind = rng.integers(5)
        if kind == 0:
            draw.rectangle((x, y, x + size, y + size * rng.uniform(0.1, 1)), ink)
        elif kind == 1:
            draw.ellipse((x, y, x + size, y + size * rng.uniform(0.3, 1)), ink)
        elif kind == 2:
            points = rng.uniform(0, size, (rng.integers(3, 6), 2)) + np.array([x, y])
            draw.polygon([tuple(p) for p in points], ink)
        elif kind == 3:
            right, down = rng.normal(0, size, 2)
            draw.line((x, y, x + right, y + down), ink, width=int(rng.integers(2, 2 + side // 50)))
        else:
            font = ImageFont.load_default(float(np.clip(size / 3, 10, side / 8)))
            draw.text((x, y), "".join(rng.choice(list(string.ascii_letters + string.digits), 8)), ink, font)
    return page


def _ink(rng: np.random.Generator) -> tuple[int, int, int]:
    """A random colour: nearly black, nearly white, or any."""
    levels = [rng.uniform(0, 0.15), rng.uniform(0.85, 1)][rng.integers(2)] + rng.normal(0, 0.02, 3)
    color = levels if rng.random() < 0.4 else rng.random(3)
    red, green, blue = np.rint(255 * np.clip(color, 0, 1)).astype(int)
    return int(red), int(green), int(blue)
