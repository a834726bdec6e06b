"""The file formats: each reader turns a file into `Contents`, and judges nothing.

`flx.assets.formats.gltf`, `obj`, `mtl` and `ply` take the files apart; here the images that a mesh names are
looked up, and decoded by the caller. Texture coordinates run right and down in what is returned, whatever
the format.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

from flx.assets.formats import gltf
from flx.assets.formats.files import BadFile, found_beside, inside, is_there, read_file, told_apart
from flx.assets.formats.gltf import Gltf
from flx.assets.formats.mtl import Mapped, parse_mtl
from flx.assets.formats.obj import parse_obj
from flx.assets.formats.obj_source import ObjSource, find_maps, read_libraries
from flx.assets.formats.parts import Material, Part
from flx.assets.formats.ply import parse_ply


class Contents(NamedTuple):
    """A file, read but not yet judged."""

    parts: list[Part]
    materials: list[Material]
    load_image: Callable[[str], bytes]
    hint: str  # where a texture was looked for
    container: Gltf | ObjSource | None
    missing_images: tuple[str, ...]
    polygons: int = 0  # faces of more than three corners, cut
    ignored_options: tuple[str, ...] = ()  # of map_Kd
    unread: tuple[str, ...] = ()  # what else a PLY has
    found_images: tuple[str, ...] = ()  # under another name than the file's


def _read_gltf(path: Path) -> Contents:
    container = gltf.read_gltf(path)
    document, images = container.document, container.document.get("images", [])
    materials = []
    for index, entry in enumerate(document.get("materials", [])):
        texture = gltf.base_slot(entry).get("index")
        image = None if texture is None else gltf.texture_image(document, texture)
        if image is not None and image < 0:
            kinds = ", ".join(document["textures"][texture].get("extensions", {})) or "no image"
            raise BadFile(f"the texture of material {index} has {kinds[:80]}; save it as PNG or JPEG")
        name = (
            None
            if image is None
            else f"{images[image].get('name', images[image].get('uri', 'image'))} #{image}"
        )
        materials.append(Material(entry.get("name", f"material {index}"), gltf.base_color(entry), name))
    materials.append(Material("default", (1.0, 1.0, 1.0), None))
    return Contents(
        parts=gltf.parts(container),
        materials=materials,
        load_image=lambda name: gltf.image_bytes(container, int(name.rpartition("#")[2])),
        hint="no material has a base colour texture",
        container=container,
        missing_images=tuple(i.get("uri", "an image without data") for i in images if "bufferView" not in i),
        found_images=container.found,
    )


def _read_obj(path: Path) -> Contents:
    content = read_file(path)
    if b"\0" in content:
        raise BadFile("not a text, as an OBJ file is; export it again")
    found = parse_obj(content.decode("utf-8-sig", errors="replace"), path.stem)
    libraries, lost, others = read_libraries(path.parent, content)
    maps, missing = find_maps(path.parent, libraries)
    defined: dict[str, Mapped] = {}
    for library in libraries.values():
        defined |= parse_mtl(library)
    hint = "no map_Kd in the material file" if libraries else "no material file, mtllib, is named"
    white = Mapped(Material(path.stem, (1.0, 1.0, 1.0), None))
    named = [defined.get(n, white._replace(material=white.material._replace(name=n))) for n in found.names]
    mapped = [*named, white]
    return Contents(
        parts=[_moved(part, mapped[part.material]) for part in found.parts],
        materials=[each.material for each in mapped],
        load_image=partial(_load_beside, path.parent),
        hint=f"{path.parent / lost[-1]} does not exist" if lost else hint,
        container=ObjSource(path.parent, content, libraries, maps, found.rows, found.colors),
        missing_images=tuple(missing),
        polygons=found.polygons,
        found_images=tuple(map(told_apart, others.items())),
        ignored_options=tuple(f"{m.material.name}: {option}" for m in mapped for option in m.options),
    )


def _moved(part: Part, mapped: Mapped) -> Part:
    """The part with its texture coordinates as `-s` and `-o` of its image place them; v runs up there."""
    if part.uvs is None or (mapped.scale, mapped.offset) == ((1.0, 1.0), (0.0, 0.0)):
        return part
    flip = [1, -1] * part.uvs + [0, 1]
    return part._replace(uvs=(flip * mapped.scale + mapped.offset) * [1, -1] + [0, 1])


def _read_ply(path: Path) -> Contents:
    found = parse_ply(read_file(path), path.stem)
    others = {
        n: o for n in found.images if not is_there(path.parent, n) and (o := found_beside(path.parent, n))
    }
    images = [others.get(name, name) for name in found.images] or [None]
    return Contents(
        parts=found.parts,
        materials=[Material(path.stem, (1.0, 1.0, 1.0), image) for image in images],
        load_image=partial(_load_beside, path.parent),
        hint="no comment TextureFile",
        container=None,
        missing_images=(),
        polygons=found.polygons,
        unread=found.unread,
        found_images=tuple(map(told_apart, others.items())),
    )


def _load_beside(folder: Path, name: str) -> bytes:
    """Raises FileNotFoundError with the name as the file has it."""
    try:
        return read_file(inside(folder, name))
    except FileNotFoundError as fault:
        raise FileNotFoundError(fault.errno, fault.strerror, name) from fault


READERS = {".obj": _read_obj, ".glb": _read_gltf, ".gltf": _read_gltf, ".ply": _read_ply}
