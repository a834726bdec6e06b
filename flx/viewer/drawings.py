"""Drawings of labels: a label for each texel, as an indexed PNG that names them."""

import io
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import UInt8
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from flx.assets.asset import Asset
from flx.assets.formats.files import read_file
from flx.assets.formats.images import open_image
from flx.geometry.atlas import Atlas, fill_gutter
from flx.geometry.labels import MOST, hexadecimal
from flx.pipeline.labels import read_labels

KEY = "flx labels"  # the text of a PNG that names its labels
LONGEST_NAME = 60


class Label(NamedTuple):
    """What texels can be painted with."""

    name: str
    color: str  # as #rrggbb


CHANGE, KEEP = Label("change", "#000000"), Label("keep", "#ffffff")


class Drawing(NamedTuple):
    """What is painted: the label of each texel. The first label is that of texels without paint."""

    labels: tuple[Label, ...]
    numbers: UInt8[Any, "H W"]


def labels_png(drawing: Drawing, atlas: Atlas) -> bytes:
    """An indexed PNG: one flat colour for each label, in the gutters too; the names of labels as a text."""
    filled = fill_gutter(np.repeat(drawing.numbers[..., None], 3, 2), atlas.covered)
    image, content, names = Image.fromarray(np.ascontiguousarray(filled[..., 0])), io.BytesIO(), PngInfo()
    colors = [bytes.fromhex(label.color[1:]) for label in drawing.labels]
    image.putpalette(b"".join(colors))
    names.add_itxt(KEY, json.dumps([label._asdict() for label in drawing.labels]))
    image.save(content, "PNG", pnginfo=names)
    return content.getvalue()


def own_drawing(path: Path) -> Drawing | None:
    """What `labels_png` wrote, to the texel; None for another image.

    Raises ValueError for a file that is not there or is no image.
    """
    if not path.exists():
        raise ValueError(f"{path} does not exist; leave out --start for an empty one")
    image: Any = open_image(read_file(path), path.name)
    if image.mode != "P" or KEY not in getattr(image, "text", {}):
        return None
    numbers = np.asarray(image)
    try:
        labels = checked_labels(json.loads(image.text[KEY]))
    except (ValueError, RecursionError):
        return None
    palette = np.array(image.getpalette(), np.uint8).reshape(-1, 3)[: len(labels)]
    same = [hexadecimal(color) for color in palette] == [label.color for label in labels]
    return Drawing(labels, numbers) if same and numbers.max(initial=0) < len(labels) else None


def foreign_drawing(path: Path, asset: Asset) -> Drawing:
    """The labels of another program's image."""
    found = read_labels(path, asset)
    if not found.mesh.textures:
        raise ValueError(f"{path} has its labels at vertices; give an image of labels")
    colors = [hexadecimal(color) for color in found.palette]
    rest = next(c for c in (f"#{128 + k:02x}8080" for k in range(MOST)) if c not in colors)
    labels = (Label("rest", rest), *(Label(color, color) for color in colors))
    if len(labels) > MOST:
        raise ValueError(f"{path} has {len(colors)} labels; one of at most {MOST} is needed for the rest")
    return Drawing(labels, (found.numbers + 1).astype(np.uint8))


def checked_labels(value: Any) -> tuple[Label, ...]:
    """Labels as JSON holds them. Raises ValueError for what is none."""
    if not isinstance(value, list) or not 2 <= len(value) <= MOST:
        raise ValueError(f"labels are not a list of 2 to {MOST}")
    labels = []
    for k, entry in enumerate(value):
        name, color = (entry.get(key) if isinstance(entry, dict) else None for key in ("name", "color"))
        if (
            not isinstance(name, str)
            or not name.strip()
            or len(name) > LONGEST_NAME
            or not name.isprintable()
        ):
            raise ValueError(f"label {k} has no name of 1 to {LONGEST_NAME} printable letters; give it one")
        if not isinstance(color, str) or not _is_color(color):
            raise ValueError(f"label {k}, {name!r}, has no colour such as #ff8800; give it one")
        labels.append(Label(name.strip(), color.lower()))
    colors: Sequence[str] = [label.color for label in labels]
    for k, color in enumerate(colors):
        if color in colors[:k]:
            one, other = labels[colors.index(color)].name, labels[k].name
            raise ValueError(f"{one!r} and {other!r} have one colour, {color}; change one of them")
    return tuple(labels)


def _is_color(text: str) -> bool:
    return re.fullmatch("#[0-9a-fA-F]{6}", text) is not None
