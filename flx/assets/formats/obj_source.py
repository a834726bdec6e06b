"""An OBJ with the files that it names, kept so that it can be written again with nothing but other colours.

The text that was read is kept as bytes (80 MB for a million faces, about the size of its arrays), so quads,
groups, smoothing, comments and the order of rows survive, and a file that changes on disk cannot be mixed
with geometry read before. Maps are read again when they are copied.

Only regular files with the suffix of an image, in the folder of the asset or below it, are copied with an
OBJ: a stranger's MTL must neither fetch a user's files nor plant a script among the results.
"""

import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int

from flx.assets.formats import mtl
from flx.assets.formats.files import BadFile, found_beside, inside, is_there, limit, read_file, text_of
from flx.assets.formats.mtl import edited, files_named, line_end, repainted
from flx.assets.formats.obj import color_scale
from flx.files import write_atomically
from flx.geometry.color import quantized

# Files that other programs read as a map; flx itself reads fewer kinds.
SUFFIXES = (".png", ".jpg", ".jpeg", ".jp2", ".webp", ".bmp", ".tga", ".tif", ".tiff")
SUFFIXES += (".gif", ".psd", ".exr", ".hdr", ".dds", ".ktx", ".ktx2")

# A statement continues in the next line after a backslash; lines end as on any system.
BOM = b"\xef\xbb\xbf"
NEXT_LINE = rb"\\(?:\r\n|\r|\n)"
GAP = rb"(?:[ \t\v\f]|" + NEXT_LINE + rb")"
START = rb"(?:\A(?:\xef\xbb\xbf)?|(?<=[\r\n])(?<!\\\r)(?<!\\\n)(?<!\\\r\n))" + GAP + rb"*+"
REST = GAP + rb"*+(?P<value>(?:" + NEXT_LINE + rb"|[^\r\n])*+)"
CONTINUED = (b"\\\n", b"\\\r", b"\\\r\n")
LIBRARY = re.compile(rb"mtllib(?=[\s\\]|\Z)" + REST)
USE = re.compile(rb"usemtl(?=[\s\\]|\Z)" + REST)
STRUCTURE = re.compile(rb"(?P<key>[ogs])(?=[\s\\])" + REST)
LINE = re.compile(rb"[lp](?=[\s\\])")
FACE = re.compile(rb"f(?=[\s\\])")
NUMBER = GAP + rb"++([^\s\\#]++)"
COLORED = re.compile(START + rb"v" + 6 * NUMBER)  # groups 4 to 6 are the colour


class ObjSource(NamedTuple):
    """The files of an OBJ, as they were read."""

    folder: Path
    text: bytes
    libraries: dict[str, bytes]  # existing MTL files, by name; absolute paths in them made relative
    maps: dict[str, str]  # existing files that these name: {name in the MTL: name in the folder}
    rows: Int[Any, "V"]  # the v of each vertex of the asset's parts in turn
    colors: Float64[Any, "P 3"] | None  # of every v, as the file counts them


def read_libraries(folder: Path, text: bytes) -> tuple[dict[str, bytes], list[str], dict[str, str]]:
    """The MTL files that an OBJ names, the names of missing ones, and the images found under another name.

    Raises BadFile for one outside of the folder, and for more than `FLX_MAX_BYTES` in all.
    """
    libraries: dict[str, bytes] = {}
    renames: dict[str, str] = {}
    missing, size = [], 0
    uses = _statements(LIBRARY, text)
    for name in dict.fromkeys(name for use in uses for name in _names(folder, use["value"])):
        try:
            content = read_file(inside(folder, name))
        except FileNotFoundError:
            missing.append(name)
            continue
        if (size := size + len(content)) > (most := limit("FLX_MAX_BYTES")):
            raise BadFile(f"its MTL files have more than {most:,} bytes; reduce them, or set FLX_MAX_BYTES")
        own = {n: _relative(folder, n) for n in files_named(content)}
        libraries[name], renames = mtl.renamed(content, own), renames | own
    return libraries, missing, {n: o for n, o in renames.items() if n != o and not is_there(folder, n)}


def _statements(pattern: re.Pattern[bytes], text: bytes) -> Iterator[re.Match[bytes]]:
    """The matches that begin a statement. Searching words is ten times faster than searching line starts."""
    for match in pattern.finditer(text):
        at = match.start()
        while at and text[at - 1] in b" \t\v\f":
            at -= 1
        before = text[max(at - 3, 0) : at]
        ended = before.endswith((b"\n", b"\r")) and not before.endswith(CONTINUED)
        if ended or at == 0 or (at == 3 and before == BOM):
            yield match


def _names(folder: Path, value: bytes) -> list[str]:
    """The files of one mtllib: a name that may hold spaces, or several that each end in .mtl."""
    whole = text_of(re.sub(NEXT_LINE, b" ", value)).strip()
    if not whole:
        return []
    several = re.split(r"(?<=\.mtl)\s+", whole, flags=re.IGNORECASE)
    return several if len(several) > 1 and not inside(folder, whole).exists() else [whole]


def _relative(folder: Path, name: str) -> str:
    """The name relative to the folder, so that it stays valid when the file is copied. A dangling name
    becomes that of the image which it means."""
    if (meant := found_beside(folder, name)).lower().endswith(SUFFIXES):
        return meant
    try:
        own = _own_name(folder, name)
    except BadFile:
        return name
    return name if own == _plain(name) else own


def _own_name(folder: Path, name: str) -> str:
    """The name of a file in its asset's folder, relative to it.

    Raises BadFile where it leads out of the folder, as `inside` does.
    """
    path, plain = inside(folder, name), _plain(name)
    if os.path.isabs(plain) or plain.split("/")[0] == "..":
        return path.relative_to(folder.resolve()).as_posix()
    return plain


def _plain(name: str) -> str:
    return os.path.normpath(name.replace("\\", "/"))


def find_maps(folder: Path, libraries: Mapping[str, bytes]) -> tuple[dict[str, str], list[str]]:
    """The files that the libraries name: those that can be copied, and those that cannot.

    Raises BadFile where they have more than four times `FLX_MAX_BYTES` in all.
    """
    copied, missing, sizes, most = {}, [], {}, limit("FLX_MAX_BYTES")
    for name in _all_files(libraries.values()):
        try:
            own, path = _own_name(folder, name), inside(folder, name)
            if own.lower().endswith(SUFFIXES) and path.is_file() and path.stat().st_size <= most:
                copied[name], sizes[own] = own, path.stat().st_size
        except (BadFile, OSError):
            pass
        if name not in copied:
            missing.append(name)
    if sum(sizes.values()) > 4 * most:
        raise BadFile(f"its maps have more than {4 * most:,} bytes; reduce them, or set FLX_MAX_BYTES")
    return copied, missing


def _all_files(libraries: Iterable[bytes]) -> list[str]:
    return list(dict.fromkeys(name for content in libraries for name in files_named(content)))


# ---------------------------------------------------------------------------------------------- writing


def write_painted(source: ObjSource, images: Mapping[str, str], fresh: str, path: Path) -> None:
    """The OBJ whose material m shows the image file `images[m]`, which is in the folder of `path`.

    "" stands for faces without a material, which get the one called `fresh`. Materials that no library
    defines are added to the first.
    """
    named = {name or fresh: image for name, image in images.items()}
    libraries = {name: repainted(content, named) for name, content in source.libraries.items()}
    defined = material_names(source)
    added = {m: image for m, image in named.items() if m not in defined}
    if added:
        first = next(iter(libraries), "")
        libraries[first] = _with_materials(libraries.get(first, b""), added)
    text = _with_material_of_the_rest(source.text, fresh) if "" in images else source.text
    write_copy(source._replace(libraries=libraries, text=text), path)


def write_colored(source: ObjSource, rows: Int[Any, "N"], colors: Float32[Any, "N 3"], path: Path) -> None:
    """The OBJ with other colours of the v in `rows`; a v that occurs several times gets the mean.

    White is 1 or 255 as in the file; other v keep their colours. Raises ValueError where a v has no colour.
    """
    channels = (match.span(group) for match in COLORED.finditer(source.text) for group in (4, 5, 6))
    places = np.fromiter((end for span in channels for end in span), np.int64).reshape(-1, 3, 2)
    if source.colors is None or len(places) != len(source.colors):
        raise ValueError(f"{len(places)} v of the OBJ have a colour, not all; export it again")
    counts = np.bincount(rows, minlength=len(source.colors))
    used = np.flatnonzero(counts)
    sums = [np.bincount(rows, channel, len(source.colors)) for channel in colors.T.astype(np.float64)]
    means = (np.stack(sums, 1)[used] / counts[used, None]).astype(np.float32)
    table = source.colors.copy()
    table[used] = quantized(means)
    # If white was 255 and the colours are now too dark to show it, they are written as if white were 1.
    whole = color_scale(source.colors) == color_scale(table) == 255
    word, numbers = (b"%d", quantized(means)) if whole else (b"%.9g", means)
    spans = zip(places[used].reshape(-1, 2).tolist(), numbers.ravel().tolist(), strict=True)
    edits = ((start, end, word % number) for (start, end), number in spans)
    write_copy(source._replace(text=edited(source.text, edits)), path)


def only_object(source: ObjSource) -> str:
    """The name of the only object; "" without one, and where there are several."""
    found = _statements(STRUCTURE, source.text)
    names = {match["value"].strip() for match in found if match["key"] == b"o"}
    return text_of(names.pop()) if len(names) == 1 else ""


def structure(source: ObjSource) -> dict[str, int]:
    """How many objects, groups and smoothing groups the text has."""
    names = {(match["key"], match["value"].strip()) for match in _statements(STRUCTURE, source.text)}
    counts = Counter(key for key, _ in names - {(b"s", b"off"), (b"s", b"0"), (b"s", b"")})
    return {"object": counts[b"o"], "group": counts[b"g"], "smoothing group": counts[b"s"]}


def has_lines(source: ObjSource) -> bool:
    """Whether the text has lines or points."""
    return next(_statements(LINE, source.text), None) is not None


def material_names(source: ObjSource) -> set[str]:
    """The materials that the libraries define."""
    found = (s for content in source.libraries.values() for s in mtl.statements(content))
    return {mtl.material_name(statement) for statement in found if statement.key == "newmtl"}


def _with_materials(library: bytes, images: Mapping[str, str]) -> bytes:
    end = line_end(library)
    lines = [f"newmtl {m}\nKd 1 1 1\nmap_Kd {image}".encode() for m, image in images.items()]
    gap = end if library and not library.endswith((b"\n", b"\r")) else b""
    return library + gap + b"".join(line + b"\n" for line in lines).replace(b"\n", end)


def _with_material_of_the_rest(text: bytes, name: str) -> bytes:
    """The text with a usemtl before its first face, and a name for each usemtl without one."""
    uses = list(_statements(USE, text))
    edits = [(use.end(), use.end(), b" " + name.encode()) for use in uses if not use["value"].strip()]
    first = next(_statements(FACE, text), None)
    if first and (not uses or first.start() < uses[0].start()):
        edits.insert(0, (first.start(), first.start(), b"usemtl " + name.encode() + line_end(text)))
    return edited(text, edits)


def library_files(source: ObjSource, path: Path) -> dict[str, Path]:
    """The path of each library that an OBJ at `path` will name; at least one."""
    names = enumerate(source.libraries or [""])
    return {name: path.with_name(f"{path.stem}_{k}.mtl" if k else f"{path.stem}.mtl") for k, name in names}


def write_copy(source: ObjSource, path: Path) -> None:
    """The maps, the libraries and, last, the OBJ that names them; all unchanged but for the MTLs' names.

    A map that is already there is not copied.
    """
    for name in _all_files(source.libraries.values()):
        if name in source.maps and not (target := inside(path.parent, source.maps[name])).exists():
            target.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(target, read_file(inside(source.folder, name)))
    files = library_files(source, path)
    for name, content in source.libraries.items():
        write_atomically(files[name], content)
    write_atomically(path, _naming(source, {name: files[name].name for name in source.libraries}))


def _naming(source: ObjSource, written: Mapping[str, str]) -> bytes:
    """The text with the names of the written files after mtllib. An MTL under the name "" is new: it replaces
    missing ones, or gets an mtllib at the top."""
    text, stand_in, edits = source.text, written.get(""), []
    for match in _statements(LIBRARY, text):
        names = [written.get(n, stand_in or n) for n in _names(source.folder, match["value"])]
        names = names or [stand_in or ""]
        start = match.start("value")
        gap = b"" if match["value"] or not names[0] else b" "
        edits.append((start, start + len(match["value"].rstrip()), gap + " ".join(names).encode()))
    if stand_in and not edits:
        at = len(BOM) if text.startswith(BOM) else 0
        edits.append((at, at, f"mtllib {stand_in}".encode() + line_end(text)))
    return edited(text, edits)


def other_names(source: ObjSource, painted: Iterable[str]) -> list[str]:
    """The files that the libraries still name after the `painted` materials get other base colours."""
    images = dict.fromkeys(painted, "\0")  # not a valid name of a file
    libraries = (repainted(content, images) for content in source.libraries.values())
    return [name for name in _all_files(libraries) if name != "\0"]


def check_maps(source: ObjSource, names: Iterable[str], folder: Path) -> None:
    """Raises ValueError where a map cannot be copied to a folder, because a different file has its name."""
    for name in names:
        target = inside(folder, source.maps[name])
        if target.exists() and read_file(target) != read_file(inside(source.folder, name)):
            raise ValueError(f"{target} exists and differs from the map {name}; name another --out")
