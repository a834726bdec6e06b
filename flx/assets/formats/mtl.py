"""MTL files: their materials, the files they name, and the same bytes with other names in them.

A library is written as it was read, but for file names. So statements are located in the bytes, and only
names are exchanged: Ns, illum, norm, comments, order and line ends stay as they are.

Options of map_Kd: `-s` and `-o` move the texture on the surface (u·s + o) and are applied to the texture
coordinates; the others are kept in their line and reported, like factors that multiply a texture.
"""

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

import numpy as np

from flx.assets.formats.files import BadFile, numbers, text_of
from flx.assets.formats.parts import Material
from flx.types import Slot

STATEMENT = re.compile(
    rb"(?:\A(?:\xef\xbb\xbf)?|(?<=[\r\n]))[ \t\v\f]*+(?P<key>[^\s#]\S*+)[ \t\v\f]*+(?P<value>[^\r\n]*+)"
)
WORD = re.compile(rb"\S+")
LINE_END = re.compile(rb"\r\n|\r|\n")

MAPS = {"bump", "disp", "decal", "refl", "norm"}  # and all that begin with map_
NO_FILE = {"map_aat"}  # a switch
OPTIONS = {b"-mm": 2, b"-o": 3, b"-s": 3, b"-t": 3}  # the most numbers that follow
FLAGS = {b"-blendu", b"-blendv", b"-bm", b"-boost", b"-cc", b"-clamp", b"-imfchan", b"-texres", b"-type"}
READ = {"newmtl", "kd", "d", "tr", "map_kd"}
# Maps of other slots. A bump map may hold heights or normals: its name must say which.
SLOTS: dict[str, Slot] = {
    **{"norm": "normal", "bump": "normal", "map_bump": "normal"},
    **{"map_pr": "metallic_roughness", "map_pm": "metallic_roughness", "map_ke": "emissive"},
}
NORMAL_MAP = re.compile(r"(?:\b|_)(?:nor|nrm|norm|normal)(?:s|map|gl)?(?:\b|_)", re.IGNORECASE)
MOST_MAPS = 1 << 12


class Statement(NamedTuple):
    """A keyword and what follows it; `content[start:end]` is `value`, and its line ends at `stop`."""

    key: str  # in lower case
    value: bytes
    start: int
    end: int
    stop: int


class FileName(NamedTuple):
    """The file that a statement names after its options, and the place of the name in the content."""

    name: str
    options: dict[str, tuple[str, ...]]
    start: int
    end: int


def statements(content: bytes) -> Iterator[Statement]:
    """Every statement of a library, without comments and empty lines."""
    for match in STATEMENT.finditer(content):
        value = match["value"].rstrip()
        start, key = match.start("value"), match["key"].decode(errors="replace").lower()
        yield Statement(key, value, start, start + len(value), match.end())


def material_name(statement: Statement) -> str:
    """The material that a newmtl defines."""
    return " ".join(_text(statement.value).split())


def _text(value: bytes) -> str:
    return text_of(value).strip()


def file_name(statement: Statement) -> FileName | None:
    """The file that a map names: everything after the last option, since names may have spaces; or None."""
    if statement.key in NO_FILE or not (statement.key in MAPS or statement.key.startswith("map_")):
        return None
    words = list(WORD.finditer(statement.value))
    options: dict[str, tuple[str, ...]] = {}
    at = 0
    while at < len(words) - 1 and words[at][0].startswith(b"-"):
        option, at = words[at][0], at + 1
        last = min(at + OPTIONS.get(option, 1), len(words) - 1)  # the last word is the name
        first = at
        if option in OPTIONS:
            while at < last and _is_number(words[at][0]):
                at += 1
        else:
            at = last if option in FLAGS else len(words) - 1
        options[option.decode(errors="replace")] = tuple(_text(word[0]) for word in words[first:at])
    if not words:
        return None
    start = words[at].start()
    name = _text(statement.value[start:])
    return FileName(name, options, statement.start + start, statement.end)


def _is_number(word: bytes) -> bool:
    try:
        return math.isfinite(float(word))
    except ValueError:
        return False


def parse_mtl(content: bytes) -> dict[str, Material]:
    """Materials by name. Diffuse colours and their images are read as sRGB.

    Raises BadFile where Kd is not three numbers.
    """
    materials: dict[str, Material] = {}
    name, dissolved = "", False  # where a material has d, its Tr (1 − d) is ignored
    for statement in statements(content):
        key, values, file = statement.key, _text(statement.value).split(), file_name(statement)
        if key == "newmtl":
            name, dissolved = material_name(statement), False
            materials[name] = Material(name)
        if not name:
            continue
        material = materials[name]
        if key == "kd" and len(values) >= 3:
            r, g, b = np.nan_to_num(numbers(" ".join(values[:3]))).clip(0, 1).tolist()
            material = material._replace(color=(r, g, b))
        elif key in ("d", "tr") and values and _is_number(statement.value.split()[-1]):
            if key == "d" or not dissolved:
                opacity = float(values[-1]) if key == "d" else 1 - float(values[-1])
                material = material._replace(opacity=min(max(opacity, 0.0), 1.0))
            dissolved |= key == "d"
        elif key == "map_d" and file:
            material = material._replace(opacity_image=file.name)
        elif key == "map_kd" and file:
            unapplied = {o: v for o, v in file.options.items() if o not in ("-s", "-o")}
            material = material._replace(
                image=file.name,
                scale=_pair(file.options.get("-s", ()), 1.0),
                offset=_pair(file.options.get("-o", ()), 0.0),
                options=tuple(" ".join([option, *words]) for option, words in unapplied.items()),
            )
        elif key in SLOTS and file:
            material = _with_map(material, SLOTS[key], file, is_bump="bump" in key)
        materials[name] = material
    return materials


def _with_map(material: Material, slot: Slot, file: FileName, is_bump: bool) -> Material:
    """The material with the map of another slot; norm takes precedence over a bump map."""
    if is_bump and (slot in material.maps or not NORMAL_MAP.search(file.name)):
        return material
    moved = material.moved | {slot} if {"-s", "-o"} & file.options.keys() else material.moved - {slot}
    return material._replace(maps={**material.maps, slot: file.name}, moved=moved)


def _pair(words: tuple[str, ...], default: float) -> tuple[float, float]:
    u, v = (*map(float, words[:2]), default, default)[:2]
    return u, v


def files_named(content: bytes) -> list[str]:
    """Every file that the maps of a library name."""
    names = dict.fromkeys(file.name for file in map(file_name, statements(content)) if file)
    if len(names) > MOST_MAPS:
        raise BadFile(f"{len(names):,} maps, more than {MOST_MAPS:,}; leave some out")
    return list(names)


def properties(content: bytes) -> list[str]:
    """The properties of materials that `parse_mtl` does not read, other than files."""
    keys = dict.fromkeys(s.key for s in statements(content) if file_name(s) is None and s.key not in READ)
    return [key.capitalize() if len(key) == 2 else key for key in keys]


def renamed(content: bytes, names: Mapping[str, str]) -> bytes:
    """The library with other names of files: {old: new}. Only names that differ change any bytes."""
    files = (file for file in map(file_name, statements(content)) if file and names[file.name] != file.name)
    return edited(content, ((file.start, file.end, names[file.name].encode()) for file in files))


def repainted(content: bytes, images: Mapping[str, str]) -> bytes:
    """The library with other images: map_Kd of material m names `images[m]`; it is added where m has none."""
    edits: dict[int, tuple[int, int, bytes]] = {}
    new, heading = b"", 0  # the image of the current material, and the end of the line of its newmtl
    for statement in statements(content):
        if statement.key == "newmtl":
            new, heading = images.get(material_name(statement), "").encode(), statement.stop
            if new:
                edits[heading] = (heading, heading, line_end(content) + b"map_Kd " + new)
        elif statement.key == "map_kd" and new and (file := file_name(statement)):
            edits.pop(heading, None)
            edits[file.start] = (file.start, file.end, new)
    return edited(content, (edits[start] for start in sorted(edits)))


def edited(content: bytes, edits: Iterable[tuple[int, int, bytes]]) -> bytes:
    """The bytes with some replaced: (start, end, new), in ascending order."""
    pieces, at = [], 0
    for start, end, new in edits:
        pieces += [content[at:start], new]
        at = end
    return b"".join([*pieces, content[at:]])


def line_end(content: bytes) -> bytes:
    """The line end of a file: that of its first line."""
    first = LINE_END.search(content)
    return first[0] if first else b"\n"
