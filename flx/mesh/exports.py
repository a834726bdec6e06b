"""An asset with new colours as OBJ (with MTL and PNG) or PLY: the triangles and coordinates of its parts.

Both are written anew: names of parts and materials are kept, node transforms are applied, numbers are exact.
What the formats cannot say (other maps, extras, alpha of vertices) stays behind; a GLB keeps it. Every file
is there whole or not at all, and the OBJ comes last: it never names what is not there yet.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int, Num, UInt8

from flx.mesh.assets import Asset, encode_png
from flx.mesh.files import write_atomically
from flx.mesh.texels import quantized

BLOCK = 1 << 14  # rows written at a time


def write_obj(asset: Asset, images: Sequence[UInt8[Any, "_ _ 3"]], path: str | Path) -> None:
    """OBJ, MTL and a PNG for each texture that is not flat, all named after `path`; alpha is kept in the PNG.

    Raises ValueError where the number of images is wrong.
    """
    path = Path(path)
    if len(images) != len(asset.textures):
        raise ValueError(f"{len(images)} images for the {len(asset.textures)} textures of {asset.path}")
    files = {}
    for index, (image, texture) in enumerate(zip(images, asset.textures, strict=True)):
        if not texture.flat:
            files[index] = f"{path.stem}_{index}.png" if len(images) > 1 else f"{path.stem}.png"
            write_atomically(path.with_name(files[index]), encode_png(image, texture.alpha))
    library = []
    for name, paint in zip(_material_names(asset), asset.paints, strict=True):
        color = (1.0, 1.0, 1.0) if paint.texture in files else paint.color
        library += [f"newmtl {name}", "Kd {} {} {}".format(*map(float, color))]
        library += [f"map_Kd {files[paint.texture]}"] if paint.texture in files else []
    write_atomically(path.with_suffix(".mtl"), ("\n".join(library) + "\n").encode())
    write_atomically(path, "\n".join(_obj_lines(asset, path.with_suffix(".mtl").name)).encode())


def write_obj_colors(asset: Asset, colors: Float32[Any, "V 3"], path: str | Path) -> None:
    """One OBJ with an sRGB colour after each position, as most readers take it."""
    write_atomically(Path(path), "\n".join(_obj_lines(asset, None, colors)).encode())


def write_ply_colors(asset: Asset, colors: Float32[Any, "V 3"], path: str | Path) -> None:
    """One binary PLY with an 8-bit sRGB colour for each original vertex; positions in float64 where float32
    would round them."""
    points = np.concatenate([part.positions for part in asset.parts])
    kind = "<f4" if (points.astype(np.float32) == points).all() else "<f8"
    named = {"float": "<f4", "double": "<f8", "uchar": "u1"}
    columns = [(axis, kind, points[:, k]) for k, axis in enumerate("xyz")]
    kept = [part.normals for part in asset.parts if part.normals is not None]
    if len(kept) == len(asset.parts):
        normals = np.concatenate(kept)
        columns += [(f"n{axis}", "<f4", normals[:, k]) for k, axis in enumerate("xyz")]
    columns += [(name, "u1", quantized(colors)[:, k]) for k, name in enumerate(("red", "green", "blue"))]
    vertices = np.empty(len(points), [(name, dtype) for name, dtype, _ in columns])
    for name, _, values in columns:
        vertices[name] = values
    rows = np.concatenate(list(_numbered_faces(asset)))
    faces = np.empty(len(rows), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, rows
    words = {dtype: word for word, dtype in named.items()}
    header = ["ply", "format binary_little_endian 1.0", "comment flx", f"element vertex {len(points)}"]
    header += [f"property {words[dtype]} {name}" for name, dtype, _ in columns]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    write_atomically(Path(path), "\n".join(header).encode() + vertices.tobytes() + faces.tobytes())


def _obj_lines(asset: Asset, library: str | None, colors: Float32[Any, "V 3"] | None = None) -> Iterator[str]:
    """The text of an OBJ, in blocks of lines; texture coordinates run up there."""
    yield from ["# flx", *([f"mtllib {library}"] if library else [])]
    rows = np.concatenate([part.positions for part in asset.parts])
    yield from _numbers("v", rows if colors is None else np.concatenate([rows, colors], 1))
    names, normals, uvs = _material_names(asset), 0, 0
    for part, faces in zip(asset.parts, _numbered_faces(asset), strict=True):
        corners = [faces + 1]
        if part.uvs is not None:
            yield from _numbers("vt", part.uvs * [1, -1] + [0, 1])
            corners.append(part.faces + uvs + 1)
            uvs += len(part.uvs)
        if part.normals is not None:
            yield from _numbers("vn", part.normals)
            corners.append(part.faces + normals + 1)
            normals += len(part.normals)
        yield f"o {_word(part.name)}"
        if library:
            yield f"usemtl {names[part.material]}"
        between = "//" if part.uvs is None else "/"
        face = "f " + " ".join([between.join(["%d"] * len(corners))] * 3)
        yield from _rows(face.__mod__, np.stack(corners, -1).reshape(len(faces), -1))
    yield ""


def _numbers(key: str, rows: Float64[Any, "N K"]) -> Iterator[str]:
    return _rows(lambda row: f"{key} " + " ".join(map(repr, row)), rows)


def _rows(line: Callable[[tuple], str], rows: Num[Any, "N K"]) -> Iterator[str]:
    """A line for each row. As Python's numbers all rows at once take ten times the memory of the text."""
    for start in range(0, len(rows), BLOCK):
        yield "\n".join(line(tuple(row)) for row in rows[start : start + BLOCK].tolist())


def _numbered_faces(asset: Asset) -> Iterator[Int[Any, "F 3"]]:
    """The faces of each part, with rows counted through the parts."""
    start = 0
    for part in asset.parts:
        yield part.faces + start
        start += len(part.positions)


def _material_names(asset: Asset) -> list[str]:
    """One word for each material, none twice."""
    names: list[str] = []
    for paint in asset.paints:
        word = _word(paint.name)
        names.append(word if word not in names else f"{word}_{len(names)}")
    return names


def _word(name: str) -> str:
    return re.sub(r"\s+", "_", name.strip()) or "unnamed"
