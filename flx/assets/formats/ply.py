"""Parses polygon files (PLY): bytes → triangles.

Our own reader. trimesh's invents vertices for an ASCII file that ends early, refuses binary files that mix
triangles and quadrangles, and reads only one of several textures; here the counts in the header are checked
against the size of the body first. An ASCII body is converted to float64 and read as a binary one.
"""

import itertools
import math
import re
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64, Int, Num

from flx.assets.formats.files import BadFile, check_faces, numbers
from flx.assets.formats.obj import colors_of, split_corners
from flx.assets.formats.parts import Part
from flx.assets.formats.polygons import cut_polygons

TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
NORMAL, COLOR = ("nx", "ny", "nz"), ("red", "green", "blue")
READ = {
    "vertex": {"x", "y", "z", *NORMAL, *COLOR},
    "face": {"vertex_indices", "vertex_index", "texcoord", "texnumber"},
}
ASCII = "ASCII text"  # not kept: flx writes binary
CHUNK = 1 << 22  # characters of an ASCII body handled at a time
PIECE = 1 << 18  # places handled at a time, where rows of different lengths may begin
MOST_HEADER = 1 << 16
COORDINATES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))


class Property(NamedTuple):
    """One property of an element; a list where `count` is the type of its length."""

    name: str
    type: str
    count: str | None


class Element(NamedTuple):
    """One element of the header."""

    name: str
    length: int
    properties: list[Property]


class Column(NamedTuple):
    """The values of one property, and for lists how many each row has, end to end."""

    values: Num[Any, "N"]
    sizes: Int[Any, "R"] | None


class Ply(NamedTuple):
    """A PLY file: its parts (`material` is the index of an image), its images, and what was not read."""

    parts: list[Part]
    images: list[str]
    polygons: int  # faces of more than three corners
    unread: tuple[str, ...]  # everything else, in words


def parse_ply(content: bytes, name: str) -> Ply:
    """Raises BadFile for a broken header, a body shorter than the header states, and indices out of range."""
    elements, images, order, head = _header(content)
    at, is_ascii = head, order is None
    body: Body = content
    if order is None:
        text = content[at:].decode("ascii", errors="replace")
        values = np.concatenate([numbers(text[a:b]) for a, b in _pieces(text)])
        body, at, order = values.astype("<f8").data.cast("B"), 0, "<"
        read_as = dict.fromkeys(TYPES.values(), "f8")
    else:
        read_as = {kind: kind for kind in TYPES.values()}
    tables = {}
    for element in elements:
        tables[element.name], at = _read(element, body, at, order, read_as)
    vertex, face = tables.get("vertex", {}), tables.get("face", {})
    corners = face.get("vertex_indices", face.get("vertex_index"))
    if corners is None or corners.sizes is None or not {"x", "y", "z"} <= vertex.keys():
        return Ply([], images, 0, ())
    kinds = {p.name: p.type for e in elements if e.name == "vertex" for p in e.properties}
    ply = _parts(name, vertex, kinds, face, corners, images)
    return ply._replace(unread=_unread(elements, content[:head], is_ascii))


# ---------------------------------------------------------------------------------------------- the file


def _header(content: bytes) -> tuple[list[Element], list[str], str | None, int]:
    """Elements, texture files, byte order (None: ASCII) and where the body begins."""
    end = re.compile(rb"^end_header[ \t]*\r?\n?", re.MULTILINE).search(content[:MOST_HEADER])
    if not content.startswith(b"ply") or end is None:
        raise BadFile("not a PLY header; export it again")
    elements, images, order = [], [], ""
    for line in content[: end.start()].decode("utf-8", errors="replace").splitlines()[1:]:
        match line.split():
            case ["format", kind, "1.0"] if kind in ORDERS:
                order = ORDERS[kind]
            case ["element", name, length] if length.isdecimal():
                elements.append(Element(name, int(length), []))
            case ["property", "list", count, kind, name] if {count, kind} <= TYPES.keys() and elements:
                elements[-1].properties.append(Property(name, TYPES[kind], TYPES[count]))
            case ["property", kind, name] if kind in TYPES and elements:
                elements[-1].properties.append(Property(name, TYPES[kind], None))
            case ["comment", word, *_] if word.lower() == "texturefile":
                images.append(line.strip().split(None, 2)[-1])
            case ["comment" | "obj_info", *_] | []:
                pass
            case _:
                raise BadFile(f"header line {line[:60]!r} is not PLY; export it again")
    if order == "":
        raise BadFile("the PLY header names no format; export it again")
    return elements, images, order, end.end()


def _unread(elements: list[Element], header: bytes, is_ascii: bool) -> tuple[str, ...]:
    """Properties, elements and comments that are not used."""
    unread = []
    for element in elements:
        names = {p.name for p in element.properties}
        known = READ.get(element.name)
        if known is None:
            unread.append(f"{element.length:,} × {element.name}")
            continue
        if element.name == "vertex":
            known = known.union(*[pair for pair in COORDINATES if set(pair) <= names][-1:])
        unread += [f"{element.name} {p.name}" for p in element.properties if p.name not in known]
    words = [line.split() for line in header.decode("utf-8", errors="replace").splitlines()]
    texts = [w for w in words if w[:1] in (["comment"], ["obj_info"]) and w[1:] not in ([], ["flx"])]
    comments = sum(w[0] == "obj_info" or w[1].lower() != "texturefile" for w in texts)
    unread += [f"{comments} comment{'s' * (comments > 1)}"] * (comments > 0)
    return (*unread, *[ASCII] * is_ascii)


Body = bytes | memoryview
Fields = list[tuple[str, str, str | None]]  # name, type, type of a list's length
Columns = dict[str, Column]
ORDERS = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}


def _pieces(text: str) -> list[tuple[int, int]]:
    """Pieces (start, end) of a text, cut at white space, whose words do not take much memory."""
    cuts = [0]
    while cuts[-1] < len(text):
        blank = re.compile(r"\s").search(text, cuts[-1] + CHUNK)
        cuts.append(blank.start() if blank else len(text))
    return list(itertools.pairwise(cuts)) or [(0, 0)]


def _read(
    element: Element, content: Body, start: int, order: str, read_as: dict[str, str]
) -> tuple[Columns, int]:
    """The columns of one element, and where the next begins."""
    if not element.properties or not element.length:
        return {}, start
    dtypes = {kind: order + word for kind, word in read_as.items()}
    fields = [(p.name, dtypes[p.type], p.count and dtypes[p.count]) for p in element.properties]
    least = sum(np.dtype(count or kind).itemsize for _, kind, count in fields)
    if len({name for name, *_ in fields}) < len(fields):
        raise BadFile(f"element {element.name!r} has a property twice; export it again")
    if start + least * element.length > len(content):
        raise BadFile(f"the file is too short for {element.length:,} × {element.name}; export it again")
    if element.name == "face":
        check_faces(element.length)
    return _read_alike(element, fields, content, start) or _read_each(element, fields, content, start)


def _read_alike(element: Element, fields: Fields, content: Body, start: int) -> tuple[Columns, int] | None:
    """Rows whose lists all have the lengths of the first row's; None if they differ."""
    layout, at = [], start
    for name, kind, count in fields:
        size = 1
        if count:
            try:
                size, at = _size(content, count, at)
            except ValueError:
                return None
            layout.append((f"{name} size", count, (1,)))
        layout.append((name, kind, (size,)))
        at += np.dtype(kind).itemsize * size
        if at > len(content):
            return None
    dtype = np.dtype(layout)
    if start + dtype.itemsize * element.length > len(content):
        return None
    rows = np.frombuffer(content, dtype, element.length, start)
    columns = {}
    for name, _, count in fields:
        sizes = np.full(element.length, rows[name].shape[1]) if count else None
        if count and (rows[f"{name} size"][:, 0] != rows[name].shape[1]).any():
            return None
        columns[name] = Column(rows[name].reshape(-1), sizes)
    return columns, start + dtype.itemsize * element.length


def _read_each(element: Element, fields: Fields, content: Body, start: int) -> tuple[Columns, int]:
    """Rows of different lengths. Only those of elements that are used are kept."""
    starts, end = _row_starts(element, fields, content, start)
    columns, at = {}, starts
    for name, kind, count in fields if element.name in READ else ():
        width, sizes = np.dtype(kind).itemsize, np.ones(len(starts), np.int64)
        if count:
            sizes = _anywhere(content, count)[at].astype(np.int64)
            at = at + np.dtype(count).itemsize
        inner = np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        values = _anywhere(content, kind)[np.repeat(at, sizes) + width * inner] if sizes.any() else []
        columns[name] = Column(np.asarray(values, kind), sizes if count else None)
        at = at + width * sizes
    return columns, end


def _row_starts(element: Element, fields: Fields, content: Body, start: int) -> tuple[Int[Any, "R"], int]:
    """Where each row begins, and where the next element does.

    Where a row ends depends on its lists. So, a piece of the file at a time, the end of a row is computed for
    every place at which one may begin; then only the links from row to row are followed one by one.
    """
    kinds = [kind for _, *both in fields for kind in both if kind]
    step = math.gcd(*(np.dtype(kind).itemsize for kind in kinds))  # places that are possible
    starts: list[Int[Any, n]] = []
    row, at = 0, start
    while row < element.length:
        places = np.arange(at, min(at + step * PIECE, len(content) + 1), step)
        ends = _row_ends(places, fields, content)
        links, here, found = ends.tolist(), 0, []
        while row + len(found) < element.length and here < len(links):
            if links[here] < 0:
                raise BadFile(f"{element.name} {row + len(found)} is cut off or broken; export it again")
            found.append(here)
            at = links[here]
            here = (at - int(places[0])) // step
        starts.append(places[found])
        row += len(found)
    return np.concatenate(starts), at


def _row_ends(places: Int[Any, "N"], fields: Fields, content: Body) -> Int[Any, "N"]:
    """The end of a row that begins at each place; −1 where there is none."""
    ends, good = places.copy(), np.ones(len(places), bool)
    for _, kind, count in fields:
        sizes = 1
        if count:
            width = np.dtype(count).itemsize
            good &= ends + width <= len(content)
            lengths = _anywhere(content, count)[np.where(good, ends, 0)].astype(np.float64)
            good &= (lengths >= 0) & (lengths < 1 << 31) & (lengths == np.floor(lengths))
            sizes = np.where(good, lengths, 0).astype(np.int64)
            ends += width
        ends += np.dtype(kind).itemsize * sizes
    return np.where(good & (ends <= len(content)), ends, -1)


def _anywhere(content: Body, kind: str) -> Num[Any, "N"]:
    """The value that begins at each byte, without a copy."""
    size = len(content) - np.dtype(kind).itemsize + 1
    return np.ndarray((max(size, 0),), kind, content, strides=(1,))


def _size(content: Body, kind: str, at: int) -> tuple[int, int]:
    """The length of a list, which in an ASCII file is a float, and where its values begin.

    Raises ValueError where it is not a length.
    """
    value = np.frombuffer(content, kind, 1, at)[0]
    if not 0 <= value < 1 << 31 or value != int(value):
        raise ValueError(f"{value} is not the length of a list")
    return int(value), at + np.dtype(kind).itemsize


# ---------------------------------------------------------------------------------------------- the mesh


def _parts(
    name: str, vertex: Columns, kinds: dict[str, str], face: Columns, corners: Column, images: list[str]
) -> Ply:
    with np.errstate(invalid="ignore"):  # numbers that are not finite are refused by name, later
        points = _stacked(vertex, "xyz")
    assert corners.sizes is not None
    if (corners.sizes < 3).any():
        raise BadFile(f"face {(corners.sizes < 3).argmax()} has fewer than three corners; export it again")
    check_faces(int((corners.sizes - 2).sum()))
    indices = corners.values.astype(np.float64)
    wrong = ~((indices >= 0) & (indices < len(points)) & (indices == np.floor(indices)))
    if wrong.any():
        raise BadFile(f"a face names vertex {indices[wrong][0]:g} of {len(points)}; export it again")
    order = indices.astype(np.int64)
    triangles, owners = cut_polygons(corners.sizes, points[order])
    faces = order[triangles]
    rows, uvs = np.arange(len(points)), None
    for pair in COORDINATES:
        uvs = _stacked(vertex, pair) if set(pair) <= vertex.keys() else uvs
    if (wedge := face.get("texcoord")) is not None and wedge.sizes is not None:
        if (wedge.sizes != 2 * corners.sizes).any():
            raise BadFile("texcoord does not have two numbers for each corner; export it again")
        coordinates = wedge.values.astype(np.float64).reshape(-1, 2)
        rows, uvs, faces = split_corners(faces, coordinates[triangles])
    if uvs is not None:
        uvs = uvs * [1, -1] + [0, 1]

    number = np.zeros(len(owners), np.int64)
    if len(images) > 1:
        if "texnumber" not in face:
            raise BadFile(f"{len(images)} texture files, and no texnumber of the faces; keep one")
        number = face["texnumber"].values.astype(np.int64)[owners]
    if len(number) and not 0 <= number.min() <= number.max() < max(len(images), 1):
        raise BadFile(f"a face has texture {number.max()} of {len(images)}; export it again")
    normals = _stacked(vertex, NORMAL) if set(NORMAL) <= vertex.keys() else None
    colors = None
    if set(COLOR) <= vertex.keys():
        colors, kind = _stacked(vertex, COLOR), kinds["red"]
        whole = kind[0] in "iu"
        colors = (colors / np.iinfo(kind).max).clip(0, 1).astype(np.float32) if whole else colors_of(colors)
    parts = [Part(name, 0, points, normals, None, colors, faces).at(rows, faces)._replace(uvs=uvs)]
    if len(images) > 1:
        whole, parts = parts[0], []
        for image in np.unique(number).tolist():
            used, compact = np.unique(faces[number == image], return_inverse=True)
            parts.append(whole.at(used, compact.reshape(-1, 3))._replace(material=image))
    return Ply(parts, images, int((corners.sizes > 3).sum()), ())


def _stacked(vertex: Columns, names: Iterable[str]) -> Float64[Any, "V C"]:
    return np.stack([vertex[name].values for name in names], 1).astype(np.float64)
