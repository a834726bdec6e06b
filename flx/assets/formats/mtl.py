"""MTL files: what they say of materials, the files they name, and the same bytes with other names in them.

A library that goes out is the one that came in. So statements are found where they stand in the bytes, and
only file names are exchanged: Ns, illum, norm, comments, order and line ends are nobody's business here.

Options of map_Kd: `-s` and `-o` move the texture on the surface (u·s + o) and are applied to the texture
coordinates; the others are kept in their line and reported, like factors that multiply a texture.
"""

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from flx.assets.formats.files import BadFile, numbers
from flx.assets.formats.parts import Material
from flx.types import Slot

STATEMENT = re.compile(
    rb"(?:\A(?:\xef\xbb\xbf)?|(?<=[\r\n]))[ \t\v\f]*+(?P<key>[^\s#]\S*+)[ \t\v\f]*+(?P<value>[^\r\n]*+)"
)
WORD = re.compile(rb"\S+")
LINE_END = re.compile(rb"\r\n|\r|\n")

MAPS = {"bump", "disp", "decal", "refl", "norm"}  # and all that begin with map_
NO_FILE = {"map_aat"}  # a switch
OPTIONS = {b"-mm": 2, b"-o": 3, b"-s": 3, b"-t": 3}  # numbers that follow, at most; one word otherwise
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

    key: str  # in small letters
    value: bytes
    start: int
    end: int
    stop: int


class FileName(NamedTuple):
    """The file that a statement names after its options, and where the name stands."""

    name: str
    options: dict[str, tuple[str, ...]]
    start: int
    end: int


class Mapped(NamedTuple):
    """A material, and how its image lies on the surface: texture coordinates are `scale`·uv + `offset`."""

    material: Material
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)
    options: tuple[str, ...] = ()  # of map_Kd that are not applied
    moved: frozenset[Slot] = frozenset()  # other slots whose image has an -s or -o


def statements(content: bytes) -> Iterator[Statement]:
    """Every statement of a library; comments and empty lines are passed over."""
    for match in STATEMENT.finditer(content):
        value = match["value"].rstrip()
        start, key = match.start("value"), match["key"].decode(errors="replace").lower()
        yield Statement(key, value, start, start + len(value), match.end())


def material_name(statement: Statement) -> str:
    """The material that a newmtl defines."""
    return " ".join(_text(statement.value).split())


def _text(value: bytes) -> str:
    return value.decode(errors="replace").strip()


def file_name(statement: Statement) -> FileName | None:
    """The file that a map names: all after the last option, for a name may hold spaces. None without one."""
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


def parse_mtl(content: bytes) -> dict[str, Mapped]:
    """Materials by name: their diffuse colour and its image, read as sRGB, how that lies on the surface,
    and how opaque they are.

    Raises BadFile where Kd is no number.
    """
    materials: dict[str, Mapped] = {}
    name, dissolved = "", set()  # where d is said, Tr (1 − d) is not listened to
    for statement in statements(content):
        values = _text(statement.value).split()
        if statement.key == "newmtl":
            name = material_name(statement)
            materials[name] = Mapped(Material(name, (1.0, 1.0, 1.0), None))
            dissolved.discard(name)
        elif statement.key == "kd" and name and len(values) >= 3:
            r, g, b = np.nan_to_num(numbers(" ".join(values[:3]))).clip(0, 1).tolist()
            materials[name] = _saying(materials[name], color=(r, g, b))
        elif statement.key in ("d", "tr") and name and values and _is_number(statement.value.split()[-1]):
            if statement.key == "d" or name not in dissolved:
                opacity = float(values[-1]) if statement.key == "d" else 1 - float(values[-1])
                materials[name] = _saying(materials[name], opacity=min(max(opacity, 0.0), 1.0))
            dissolved |= {name} if statement.key == "d" else set()
        elif statement.key == "map_d" and name and (file := file_name(statement)):
            materials[name] = _saying(materials[name], opacity_image=file.name)
        elif statement.key == "map_kd" and name and (file := file_name(statement)):
            unapplied = {o: v for o, v in file.options.items() if o not in ("-s", "-o")}
            materials[name] = materials[name]._replace(
                material=materials[name].material._replace(image=file.name),
                scale=_pair(file.options.get("-s", ()), 1.0),
                offset=_pair(file.options.get("-o", ()), 0.0),
                options=tuple(" ".join([option, *words]) for option, words in unapplied.items()),
            )
        elif statement.key in SLOTS and name and (file := file_name(statement)):
            materials[name] = _with_map(materials[name], statement.key, file)
    return materials


def _with_map(mapped: Mapped, key: str, file: FileName) -> Mapped:
    """The material with the map of another slot; norm goes before a bump map."""
    slot, maps = SLOTS[key], mapped.material.maps
    if "bump" in key and (slot in maps or not NORMAL_MAP.search(file.name)):
        return mapped
    moved = mapped.moved | {slot} if {"-s", "-o"} & file.options.keys() else mapped.moved - {slot}
    return _saying(mapped, maps={**maps, slot: file.name})._replace(moved=moved)


def _saying(mapped: Mapped, **properties: Any) -> Mapped:
    return mapped._replace(material=mapped.material._replace(**properties))


def _pair(words: tuple[str, ...], default: float) -> tuple[float, float]:
    u, v = (*map(float, words[:2]), default, default)[:2]
    return u, v


def files_named(content: bytes) -> list[str]:
    """Every file that the maps of a library name, as it names them."""
    names = dict.fromkeys(file.name for s in statements(content) if (file := file_name(s)))
    if len(names) > MOST_MAPS:
        raise BadFile(f"{len(names):,} maps, more than {MOST_MAPS:,}; leave some out")
    return list(names)


def properties(content: bytes) -> list[str]:
    """What a library says of materials besides the files it names and what `parse_mtl` reads."""
    keys = dict.fromkeys(s.key for s in statements(content) if file_name(s) is None and s.key not in READ)
    return [key.capitalize() if len(key) == 2 else key for key in keys]


def renamed(content: bytes, names: Mapping[str, str]) -> bytes:
    """The library with other names of files: {old: new}; where they are the same, not a byte changes."""
    files = filter(None, map(file_name, statements(content)))
    return edited(
        content, ((f.start, f.end, names[f.name].encode()) for f in files if names[f.name] != f.name)
    )


def repainted(content: bytes, images: Mapping[str, str]) -> bytes:
    """The library with other images: map_Kd of material m names `images[m]`, added where m has none."""
    edits: list[tuple[int, int, bytes]] = []
    new = added = b""
    heading = 0  # the end of the line of newmtl

    def close() -> None:
        if added:
            edits.append((heading, heading, added))

    for statement in statements(content):
        if statement.key == "newmtl":
            close()
            new = images.get(material_name(statement), "").encode()
            heading = statement.stop
            added = line_end(content) + b"map_Kd " + new if new else b""
        elif statement.key == "map_kd" and new and (file := file_name(statement)):
            edits.append((file.start, file.end, new))
            added = b""
    close()
    return edited(content, sorted(edits))


def edited(content: bytes, edits: Iterable[tuple[int, int, bytes]]) -> bytes:
    """The bytes with some of them exchanged: (start, end, new), in order."""
    pieces, at = [], 0
    for start, end, new in edits:
        pieces += [content[at:start], new]
        at = end
    return b"".join([*pieces, content[at:]])


def line_end(content: bytes) -> bytes:
    """How the lines of a file end."""
    first = LINE_END.search(content)
    return first[0] if first else b"\n"
