"""A direction as options say it: a word, or a file of strokes."""

import hashlib
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from flx.arguments import briefly
from flx.assets.asset import Asset
from flx.assets.formats.files import read_file
from flx.geometry.direction import WORDS, Direction, Stroke, check_direction

MOST_POINTS, MOST_BYTES = 10_000, 1 << 22  # of a file of strokes
FORMAT = '{"strokes": [{"points": [[x, y, z], …]}, …]}'


def file_of(said: str) -> Path | None:
    """The file that a direction names; None for a word."""
    return None if said in WORDS else Path(said)


def digest_of_direction(said: str) -> str:
    """Of its content, not of its file's name."""
    file = file_of(said)
    return hashlib.sha256(f"direction {said}".encode() if file is None else read_file(file)).hexdigest()


def read_direction(said: str, asset: Asset) -> Direction:
    """The direction of an asset's surface: a word as it is, or the strokes of a file.

    Raises ValueError, in one line, for a file that holds no strokes, or strokes that are not on the surface,
    and for a word that gives the surface no direction.
    """
    file = file_of(said)
    if file is not None and not file.exists():
        raise ValueError(
            f"direction {said} does not exist; give {', '.join(WORDS)}, or a JSON file of strokes"
        )
    try:
        direction = said if file is None else strokes_of(read_file(file))
        check_direction(direction, asset.mesh)
    except ValueError as fault:
        raise ValueError(f"direction {said}: {fault}") from None
    return direction


def strokes_of(content: bytes) -> tuple[Stroke, ...]:
    """The strokes of a file. Raises ValueError for what is none, with its place and the remedy."""
    if len(content) > MOST_BYTES:
        raise ValueError(f"it has {len(content):,} bytes; give at most {MOST_BYTES:,}")
    try:
        record = json.loads(content)
    except (ValueError, RecursionError):
        raise ValueError(f"it is not JSON; write {FORMAT}") from None
    strokes = record.get("strokes") if isinstance(record, dict) else None
    if not isinstance(strokes, list) or not strokes:
        raise ValueError(f"it has no strokes; write {FORMAT}")
    count = sum(
        len(s["points"]) for s in strokes if isinstance(s, dict) and isinstance(s.get("points"), list)
    )
    if count > MOST_POINTS:
        raise ValueError(f"it has {count:,} points; give at most {MOST_POINTS:,}")
    return tuple(_stroke(stroke, f"strokes[{n}]") for n, stroke in enumerate(strokes))


def _stroke(value: Any, name: str) -> Stroke:
    if not isinstance(value, dict) or not isinstance(value.get("points"), list):
        raise ValueError(f"{name} has no list of points; write {FORMAT}")
    if odd := [key for key in value if key not in ("points", "direction")]:
        raise ValueError(
            f"{name} has an unknown field {briefly(odd[0])}; give points, and direction if need be"
        )
    points = [_triple(point, f"{name}.points[{k}]") for k, point in enumerate(value["points"])]
    direction = None
    if "direction" in value:
        direction = _triple(value["direction"], f"{name}.direction")
        if not direction.any():
            raise ValueError(f"{name}.direction is zero; give a vector that points somewhere")
        direction = direction / np.abs(direction).max()
    if len(points) < (2 if direction is None else 1):
        raise ValueError(f"{name} has too few points, {len(points)}; give two, or one and a direction")
    placed = np.array(points)
    if len(points) > 1 and not (placed != placed[0]).any():
        raise ValueError(f"{name} has no length; give points that differ")
    return Stroke(placed, direction)


def _triple(value: Any, name: str) -> np.ndarray:
    def is_number(x: Any) -> bool:
        return isinstance(x, int | float) and not isinstance(x, bool) and abs(x) < 1e150 and math.isfinite(x)

    if not isinstance(value, list) or len(value) != 3 or not all(map(is_number, value)):
        said = briefly(json.dumps(value)).strip("'")
        raise ValueError(f"{name} is {said}; give three finite numbers")
    return np.array(value, float)
