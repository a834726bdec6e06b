"""The file formats: each reader turns a file into `Contents`, and judges nothing.

`flx.mesh.gltf`, `obj` and `ply` take the files apart; here the images that a mesh names are looked up, and
decoded by the caller. Texture coordinates run right and down in what is returned, whatever the format.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

from flx.mesh import gltf
from flx.mesh.files import BadFile, inside, read_file
from flx.mesh.gltf import Gltf, Material, Part
from flx.mesh.obj import parse_mtl, parse_obj
from flx.mesh.ply import parse_ply


class Contents(NamedTuple):
    """A file, read but not yet judged."""

    parts: list[Part]
    materials: list[Material]
    load_image: Callable[[str], bytes]
    hint: str  # where a texture was looked for
    container: Gltf | None
    missing_images: tuple[str, ...]
    polygons: int = 0  # faces of more than three corners, cut


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
    )


def _read_obj(path: Path) -> Contents:
    found = parse_obj(_read_text(path), path.stem)
    defined: dict[str, Material] = {}
    hint = "no material file, mtllib, is named" if not found.libraries else "no map_Kd in the material file"
    for library in dict.fromkeys(found.libraries):
        try:
            defined |= parse_mtl(read_file(inside(path.parent, library)).decode(errors="replace"))
        except FileNotFoundError:
            hint = f"{path.parent / library} does not exist"
    white = Material(path.stem, (1.0, 1.0, 1.0), None)
    return Contents(
        parts=found.parts,
        materials=[defined.get(name, white._replace(name=name)) for name in found.names] + [white],
        load_image=partial(_load_beside, path.parent),
        hint=hint,
        container=None,
        missing_images=(),
        polygons=found.polygons,
    )


def _read_text(path: Path) -> str:
    content = read_file(path)
    if b"\0" in content:
        raise BadFile("not a text, as an OBJ file is; export it again")
    return content.decode("utf-8", errors="replace")


def _read_ply(path: Path) -> Contents:
    found = parse_ply(read_file(path), path.stem)
    images = found.images or [None]
    return Contents(
        parts=found.parts,
        materials=[Material(path.stem, (1.0, 1.0, 1.0), image) for image in images],
        load_image=partial(_load_beside, path.parent),
        hint="no comment TextureFile",
        container=None,
        missing_images=(),
        polygons=found.polygons,
    )


def _load_beside(folder: Path, name: str) -> bytes:
    return read_file(inside(folder, name))


READERS = {".obj": _read_obj, ".glb": _read_gltf, ".gltf": _read_gltf, ".ply": _read_ply}
