"""Reads a mesh to be painted: it needs no texture, and whatever colours it has are replaced.

Its own texture coordinates are used where every point of it has texels of its own; otherwise it gets charts
by xatlas (the extra `uv`). Every material is painted.
"""

import importlib.util
import io
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

import numpy as np
from jaxtyping import UInt8

from flx.arguments import check_word, path_of
from flx.assets.assemble import assemble, faults_of
from flx.assets.asset import Asset, Format
from flx.assets.formats import glb
from flx.assets.formats.files import BadFile, check_faces, read_file
from flx.assets.formats.gltf import Gltf
from flx.assets.formats.images import check_together, decode_image
from flx.assets.formats.parts import Material, Part
from flx.assets.formats.readers import READERS, Contents, Picture, Reader
from flx.assets.inspect import coverage
from flx.assets.preflight import left_behind
from flx.assets.read import read_contents
from flx.assets.unwrap import unwrapped
from flx.geometry.arrays import distinct_rows, face_areas
from flx.geometry.atlas import uv_areas

SIDE = 1024  # pixels on the longer side of a new image; a smaller one is enlarged to at least as many
FLAT = 0.01  # share of the surface that may have no area on the texture
SHARED = 0.1  # share of its texels that may show several places


def read_shape(path: str | Path, format: Format = "glb") -> Asset:
    """Read a mesh to paint, with a texture or without one.

    Args:
        path: A .glb, .gltf, .obj, .ply, .stl or .off file.
        format: What it will be written as; a "ply" gets colours at its vertices.

    Raises FileNotFoundError, or ValueError for a file without triangles or with an unreadable part, and for
    one that needs texture coordinates where xatlas is not installed.

    Example:
        shape = flx.load_shape("other.stl")
        painting = next(flx.generate(generator, asset=shape))
        flx.save(shape, painting, "other.glb")
    """
    path = path_of("path", path, "a mesh file, such as 'bowl.glb'")
    check_word("format", format, get_args(Format))
    contents = read_contents(path, SHAPES)
    charted, fault = (None, "") if format == "ply" else _charted(path, contents)
    if charted and not fault:
        return charted
    with faults_of(path):
        bare = assemble(path, _without_images(contents))
    if format == "ply":
        return bare
    if charted and importlib.util.find_spec("xatlas") is None:
        print(f"{path}: {fault}; install the extra uv for new charts", file=sys.stderr)
        return charted
    fresh = unwrapped(bare)
    lost = left_behind((charted or bare)._replace(container=contents.container), "")
    note = f"{fault or 'no texture coordinates'}, so it gets new charts" + f"; {lost} stay behind" * bool(
        lost
    )
    print(f"{path}: {note}", file=sys.stderr)
    return fresh


def _charted(path: Path, contents: Contents) -> tuple[Asset | None, str]:
    """The asset with an image for each material on its own texture coordinates, and what is wrong with them.

    None where it has none that can be used at all.
    """
    if any(part.uvs is None for part in contents.parts):
        return None, ""
    try:
        asset = assemble(path, _with_images(contents))
    except (OSError, ValueError):  # of coordinates; other faults come again without them
        return None, "its texture coordinates cannot be used"
    areas = face_areas(asset.mesh.vertices, asset.mesh.faces)
    flat = areas[np.abs(uv_areas(asset.mesh)) <= 1e-14].sum() / areas.sum()
    if flat > FLAT:
        return None, f"{flat:.0%} of it has no area on its texture"
    shared = coverage(asset)[1]
    return asset, f"{shared:.0%} of its texels show several places" if shared > SHARED else ""


def _with_images(contents: Contents) -> Contents:
    """An image for each material that is used: its own where that can be read, else a white one.

    A file whose materials all had images stays what it was; so does a glTF, without its tints.
    """
    materials, pictures, container = list(contents.materials), _own_pictures(contents), contents.container
    bare = [number for number in contents.used if materials[number].image not in pictures]
    for number in bare:
        name = f"new image {number}"
        materials[number] = materials[number]._replace(image=name)
        pictures[name] = np.full((SIDE, SIDE, 3), 255, np.uint8)
    if isinstance(container, Gltf):
        container = glb.untinted(container)
    elif bare:
        container = None
    return contents._replace(materials=materials, load_image=pictures.__getitem__, container=container)


def _own_pictures(contents: Contents) -> dict[str, Picture]:
    """The images of the file that can be read, with their alpha."""
    encoded: dict[str, bytes] = {}
    pictures: dict[str, Picture] = {}
    for name in dict.fromkeys(contents.materials[number].image for number in contents.used):
        try:
            content = contents.load_image(name) if name else None
            if name and isinstance(content, bytes):
                check_together({**encoded, name: content})
                image, alpha = decode_image(content, name)
                encoded[name] = content
                pictures[name] = _enlarged(image if alpha is None else np.dstack([image, alpha]))
        except (OSError, ValueError):  # missing, broken or too large: it is not needed
            continue
    return pictures


def _enlarged(picture: Picture) -> UInt8[Any, "_ _ C"]:
    times = -(-SIDE // max(picture.shape[:2]))
    return picture.repeat(times, 0).repeat(times, 1)


def _without_images(contents: Contents) -> Contents:
    """The triangles in white."""
    parts = [
        part._replace(uvs=None, colors=np.ones((len(part.positions), 3), np.float32), origin=(-1, -1))
        for part in contents.parts
    ]
    materials = [material._replace(image=None) for material in contents.materials]
    return contents._replace(parts=parts, materials=materials, container=None, missing_images=())


def _read_other(path: Path) -> Contents:
    """A format that holds triangles alone, by trimesh; vertices at the same position are one."""
    import trimesh

    content = read_file(path)
    if path.suffix.lower() == ".stl" and not content.lstrip().startswith(b"solid"):
        count = int.from_bytes(content[80:84], "little")
        if len(content) < 84 + 50 * count:
            raise BadFile(f"{count:,} triangles do not fit into {len(content):,} bytes; export it again")
    mesh: Any = trimesh.load_mesh(io.BytesIO(content), file_type=path.suffix[1:].lower(), process=False)
    check_faces(len(mesh.faces))
    first, which = distinct_rows(np.asarray(mesh.vertices, np.float64))
    faces = which[np.asarray(mesh.faces, np.int64)]
    part = Part(path.stem, 0, np.asarray(mesh.vertices, np.float64)[first], None, None, None, faces)
    return Contents([part], [Material(path.stem)], lambda _: b"")


SHAPES: Mapping[str, Reader] = {**READERS, ".stl": _read_other, ".off": _read_other}
