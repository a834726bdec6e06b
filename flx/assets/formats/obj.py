"""Parses Wavefront OBJ: text → triangles by material.

Our own reader. trimesh's drops rows that it does not understand, wraps indices that are out of range and
leaves quadrangles to its mesh class; here every number is read, or the file is refused. Relative indices
count from their own line; corners that differ in v, vt or vn are different vertices. `formats.polygons` cuts
polygons, `formats.mtl` reads the materials, `formats.obj_source` keeps the text and writes it again.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int

from flx.assets.formats.files import BadFile, check_faces, numbers
from flx.assets.formats.parts import Part
from flx.assets.formats.polygons import cut_polygons
from flx.geometry.arrays import distinct_rows
from flx.types import Faces

PIECE = 1 << 20  # characters cut into lines at a time
CHUNK = 1 << 15  # rows handled at a time
MOST_MATERIALS = 1 << 12
OMITTED = 1 << 62  # stands for the vt of `1//2`


class Obj(NamedTuple):
    """An OBJ file: its parts, and the names of their materials."""

    parts: list[Part]
    names: list[str]  # `Part.material` is an index here, `len(names)` before any usemtl
    rows: Int[Any, "V"]  # the v, from 0, of each vertex of the parts in turn
    colors: Float64[Any, "P 3"] | None  # of every v, in the file's numbers
    polygons: int  # faces of more than three corners


class Lines(NamedTuple):
    """The rows of one keyword, without it, and their line numbers, ascending from 1."""

    rows: list[str]
    places: Int[Any, "N"]


def parse_obj(text: str, name: str) -> Obj:
    """An OBJ file; parts without a material are called `name`.

    Raises BadFile for words that are not numbers, faces of fewer than three corners and indices out of range.
    """
    lines = _split(text)
    faces, uses = lines["f"], lines["usemtl"]
    check_faces(len(faces.rows))
    points, uvs, normals = (_table(lines[kind].rows, kind, least) for kind, least in KINDS)
    sizes = np.array([len(row.split()) for row in faces.rows], np.int64)
    if len(sizes) and sizes.min() < 3:
        line = faces.places[sizes.argmin()]
        raise BadFile(f"the face on line {line} has {sizes.min()} corners; export it again")
    check_faces(int((sizes - 2).sum()))
    corners = _resolve(_corners(faces.rows), np.repeat(faces.places, sizes), lines)
    triangles, owners = cut_polygons(sizes, points[corners[:, 0], :3])

    numbered: dict[str, int] = {}
    of_use = [numbered.setdefault(" ".join(row.split()), len(numbered)) for row in uses.rows]
    if len(numbered) > MOST_MATERIALS:
        raise BadFile(f"{len(numbered):,} materials, more than {MOST_MATERIALS:,}; join some")
    of_face = np.array([len(numbered), *of_use])[np.searchsorted(uses.places, faces.places)]
    del lines["v"], lines["vt"], lines["vn"], lines["f"], faces  # words take more memory than numbers
    names, parts, used_rows = list(numbered), [], []
    counted = points[:, 3:6] if points.shape[1] >= 6 else None
    colors = None if counted is None else colors_of(counted)
    of_triangle = of_face[owners]
    order = np.argsort(of_triangle, kind="stable")
    used, starts = np.unique(of_triangle[order], return_index=True)
    groups = np.split(order, starts)[1:]
    for material, members in zip(used.tolist(), groups, strict=True):
        rows, part_faces = unmerge(corners[triangles[members]].reshape(-1, 3))
        v, vt, vn = rows.T
        used_rows.append(v)
        parts.append(
            Part(
                name=[*names, name][material],
                material=material,
                positions=points[v, :3],
                normals=None if (vn == OMITTED).any() else normals[vn, :3],
                uvs=None if (vt == OMITTED).any() else uvs[vt, :2] * [1, -1] + [0, 1],
                colors=None if colors is None else colors[v],
                faces=part_faces,
            )
        )
    used_rows = np.concatenate([[], *used_rows]).astype(np.int64)
    return Obj(parts, names, used_rows, counted, int((sizes > 3).sum()))


KINDS = (("v", 3), ("vt", 2), ("vn", 3))  # with the fewest numbers of a row


def _split(text: str) -> dict[str, Lines]:
    text = text.replace("\r\n", "\n").replace("\r", "\n").replace("\\\n", " ")
    rows: dict[str, list[str]] = {key: [] for key in ("v", "vt", "vn", "f", "usemtl")}
    places: dict[str, list[int]] = {key: [] for key in rows}
    for place, line in enumerate(_lines(text), 1):
        key, *rest = line.split(None, 1)[:2] or [""]
        if key in rows:
            row = rest[0] if rest else ""
            rows[key].append(row if key == "usemtl" else row.partition("#")[0])
            places[key].append(place)
    return {key: Lines(rows[key], np.array(places[key], np.int64)) for key in rows}


def _lines(text: str) -> Iterator[str]:
    """The lines of a text, a piece at a time: all at once they take several times its memory."""
    start = 0
    while start <= len(text):
        end = text.find("\n", start + PIECE)
        end = len(text) if end < 0 else end
        yield from text[start:end].split("\n")
        start = end + 1


def _chunks(rows: Sequence[str]) -> Iterator[Sequence[str]]:
    return (rows[start : start + CHUNK] for start in range(0, len(rows), CHUNK))


def _table(rows: Sequence[str], kind: str, least: int) -> Float64[Any, "N C"]:
    """The numbers of each row; columns that only some rows have (colours) are left out."""
    widths = [len(row.split()) for row in rows]
    width = min(widths, default=least)
    if width < least:
        place = widths.index(width)
        raise BadFile(f"{kind} {place + 1}, {rows[place].strip()!r}, needs {least} numbers; export it again")
    if max(widths, default=width) > width:
        rows = [" ".join(row.split()[:width]) for row in rows]
    tables = [numbers(" ".join(chunk)).reshape(-1, width) for chunk in _chunks(rows)]
    return np.concatenate(tables) if tables else np.zeros((0, width))


def _corners(rows: Sequence[str]) -> Int[Any, "C 3"]:
    """v, vt and vn of every corner with the file's indices, `OMITTED` where it has none."""
    tables = []
    for chunk in _chunks(rows):
        words = " ".join(chunk).split()
        slashes = {word.count("/") for word in words}
        text = " ".join(words).replace("//", f"/{OMITTED}/").replace("/", " ")
        if len(slashes) > 1 or max(slashes) > 2 or len(text.split()) != len(words) * (max(slashes) + 1):
            text, slashes = " ".join(_whole_corner(word) for word in words), {2}
        indices = numbers(text, np.int64).reshape(len(words), -1)
        missing = np.full((len(words), 3 - indices.shape[1]), OMITTED)
        tables.append(np.concatenate([indices, missing], 1))
    return np.concatenate(tables) if tables else np.zeros((0, 3), np.int64)


def _whole_corner(word: str) -> str:
    indices = word.split("/")
    if not indices[0] or len(indices) > 3:
        raise BadFile(f"{word[:40]!r} is not a corner of a face; export it again")
    return " ".join([*(index or str(OMITTED) for index in indices), *[str(OMITTED)] * (3 - len(indices))])


def _resolve(corners: Int[Any, "C 3"], places: Int[Any, "C"], lines: dict[str, Lines]) -> Int[Any, "C 3"]:
    """The indices, counted from 0. Negative ones count back from the face's own line."""
    resolved = np.empty_like(corners)
    for column, (kind, _) in enumerate(KINDS):
        index, table = corners[:, column], lines[kind].places
        zero_based = np.where(index > 0, index - 1, np.searchsorted(table, places) + index)
        wrong = ((index == 0) | (zero_based < 0) | (zero_based >= len(table))) & (index != OMITTED)
        if wrong.any():
            at = int(wrong.argmax())
            counted = "OBJ counts from 1" if index[at] == 0 else f"there are {len(table)}"
            raise BadFile(f"line {places[at]} names {kind} {index[at]}, but {counted}; export it again")
        resolved[:, column] = np.where(index == OMITTED, OMITTED, zero_based)
    return resolved


def unmerge(corners: Int[Any, "C K"]) -> tuple[Int[Any, "R K"], Int[Any, "F 3"]]:
    """The distinct (v, vt, vn) of triangles laid end to end, by v, and the faces made of them."""
    first, which = distinct_rows(corners)
    return corners[first], which.reshape(-1, 3)


def split_corners(
    faces: Faces, uvs: Float64[Any, "F 3 2"]
) -> tuple[Int[Any, "R"], Float64[Any, "R 2"], Int[Any, "F 3"]]:
    """A row for each vertex and coordinate that occur together: its vertex, its coordinate, and the faces."""
    first, which = distinct_rows(uvs.reshape(-1, 2))
    rows, split = unmerge(np.stack([faces.ravel(), which], 1))
    return rows[:, 0], uvs.reshape(-1, 2)[first][rows[:, 1]], split


def colors_of(values: Float64[Any, "N 3"]) -> Float32[Any, "N 3"]:
    """All colours of a file, scaled to [0, 1]; white is 1 in the file or, in some, 255."""
    return (values / color_scale(values)).clip(0, 1).astype(np.float32)


def color_scale(values: Float64[Any, "N 3"]) -> int:
    """The number that means white in a file with these colours: 1 or 255."""
    return 255 if np.fmax.reduce(values, axis=None, initial=0) > 1 else 1
