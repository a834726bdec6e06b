"""The readers: each turns a file of one format into `Contents`, which `flx.assets.assemble` checks.

`flx.assets.formats.gltf`, `obj`, `mtl` and `ply` parse the files; here the images that a mesh names are
looked up, and the caller decodes them. In `Contents` texture coordinates always run right and down.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64, UInt8

from flx.assets.formats import glb, gltf
from flx.assets.formats.files import BadFile, found_beside, inside, read_file, substitution, text_of
from flx.assets.formats.gltf import Gltf
from flx.assets.formats.mtl import parse_mtl
from flx.assets.formats.obj import parse_obj
from flx.assets.formats.obj_source import ObjSource, find_maps, read_libraries
from flx.assets.formats.parts import Material, Part
from flx.assets.formats.ply import parse_ply
from flx.geometry.color import srgb
from flx.types import SLOTS, Slot

PICTURES = (".png", ".jpg", ".jpeg")
Picture = UInt8[Any, "H W C"]  # an image that was given as an array: RGB, or RGBA


class Contents(NamedTuple):
    """A file, read but not yet checked."""

    parts: list[Part]
    materials: list[Material]
    load_image: Callable[[str], bytes | Picture]
    hint: str = ""  # where a texture was looked for
    beside: Path | None = None  # an image in the folder of a mesh that names none
    container: Gltf | ObjSource | None = None
    missing_images: tuple[str, ...] = ()
    polygons: int = 0  # faces of more than three corners, cut
    ignored_options: tuple[str, ...] = ()  # of map_Kd
    unread: tuple[str, ...] = ()  # other properties, elements and comments of a PLY
    found_images: tuple[str, ...] = ()  # images found under another name than the file's
    slot_uvs: Callable[[Part, Slot], Float64[Any, "V 2"] | None] = lambda part, _: part.uvs

    @property
    def used(self) -> list[int]:
        """The materials of the parts."""
        return sorted({part.material for part in self.parts})


def _read_gltf(path: Path) -> Contents:
    return gltf_contents(gltf.read_gltf(path))


def gltf_contents(container: Gltf) -> Contents:
    """What a glTF holds."""
    document, images = container.document, container.document.get("images", [])
    materials = []
    for index, entry in enumerate(document.get("materials", [])):
        names: dict[Slot, str] = {}
        for slot in SLOTS:
            texture = gltf.texture_reference(entry, slot).get("index")
            image = None if texture is None else gltf.texture_image(document, texture)
            if image is not None and image >= 0:
                names[slot] = f"{images[image].get('name', images[image].get('uri', 'image'))} #{image}"
            elif image is not None and slot == "base_color":
                kinds = ", ".join(document["textures"][texture].get("extensions", {})) or "no image"
                raise BadFile(f"the texture of material {index} has {kinds[:80]}; save it as PNG or JPEG")
        name, base = entry.get("name", f"material {index}"), names.pop("base_color", None)
        flat = _flat_values(entry)
        materials.append(Material(name, flat.pop("base_color"), base, maps=names, flat=flat))
    materials.append(Material("default"))
    return Contents(
        parts=gltf.parts(container),
        materials=materials,
        load_image=lambda name: gltf.image_bytes(container, int(name.rpartition("#")[2])),
        hint="no material has a base colour texture",
        container=container,
        missing_images=tuple(glb.missing_images(container)),
        found_images=container.substitutions,
        slot_uvs=partial(gltf.slot_uvs, container),
    )


def _flat_values(material: dict) -> dict[Slot, tuple[float, float, float]]:
    """The values of a material without images, colours in sRGB; entries that are not numbers are left out."""
    pbr = material.get("pbrMetallicRoughness", {})
    factors: dict[Slot, Any] = {
        "base_color": pbr.get("baseColorFactor", [1, 1, 1])[:3],
        "metallic_roughness": [1.0, pbr.get("roughnessFactor", 1), pbr.get("metallicFactor", 1)],
        "emissive": material.get("emissiveFactor"),
    }
    values: dict[Slot, tuple[float, float, float]] = {}
    for slot, rows in factors.items():
        if isinstance(rows, list) and len(rows) == 3 and all(isinstance(x, int | float) for x in rows):
            r, g, b = rows if slot == "metallic_roughness" else srgb(np.array(rows))
            values[slot] = (float(r), float(g), float(b))
    return values


def _read_obj(path: Path) -> Contents:
    content = read_file(path)
    if b"\0" in content:
        raise BadFile("not text, as an OBJ file is; export it again")
    obj = parse_obj(text_of(content), path.stem)
    libraries, lost, renames = read_libraries(path.parent, content)
    maps, missing = find_maps(path.parent, libraries)
    defined: dict[str, Material] = {}
    for library in libraries.values():
        defined |= parse_mtl(library)
    hint = "no map_Kd in the material file" if libraries else "no material file, mtllib, is named"
    materials = [*(defined.get(n, Material(n)) for n in obj.names), Material(path.stem)]
    return Contents(
        parts=[_moved(part, materials[part.material]) for part in obj.parts],
        materials=materials,
        load_image=partial(load_beside, path.parent),
        hint=f"{path.parent / lost[-1]} does not exist" if lost else hint,
        beside=None if maps else image_beside(path),
        container=ObjSource(path.parent, content, libraries, maps, obj.rows, obj.colors),
        missing_images=tuple(missing),
        polygons=obj.polygons,
        found_images=tuple(map(substitution, renames.items())),
        ignored_options=tuple(f"{m.name}: {option}" for m in materials for option in m.options),
        slot_uvs=lambda part, slot: _obj_uvs(part, materials[part.material], slot),
    )


def _obj_uvs(part: Part, material: Material, slot: Slot) -> Float64[Any, "V 2"] | None:
    """Raises BadFile for a roughness map, and for one that is not placed like map_Kd."""
    name = material.name
    if slot == "metallic_roughness" and slot in material.maps:
        raise BadFile(f"map_Pr and map_Pm of {name!r} are not read; convert the mesh to GLB")
    if slot in material.maps and (slot in material.moved or material.is_placed):
        raise BadFile(f"the {slot} map of {name!r} and its map_Kd have -s or -o; convert the mesh to GLB")
    return part.uvs


def _moved(part: Part, material: Material) -> Part:
    """The part with its texture coordinates as `-s` and `-o` of its image place them; for these v runs up."""
    if part.uvs is None or not material.is_placed:
        return part
    flip = [1, -1] * part.uvs + [0, 1]
    return part._replace(uvs=(flip * material.scale + material.offset) * [1, -1] + [0, 1])


def _read_ply(path: Path) -> Contents:
    ply = parse_ply(read_file(path), path.stem)
    renames = {name: found for name in ply.images if (found := found_beside(path.parent, name))}
    images = [renames.get(name, name) for name in ply.images] or [None]
    return Contents(
        parts=ply.parts,
        materials=[Material(path.stem, image=image) for image in images],
        load_image=partial(load_beside, path.parent),
        hint="no comment TextureFile",
        beside=None if ply.images else image_beside(path),
        polygons=ply.polygons,
        unread=ply.unread,
        found_images=tuple(map(substitution, renames.items())),
    )


def image_beside(mesh: Path) -> Path | None:
    """An image in the mesh's folder: of its name, or the only one there."""
    images = sorted(file for file in mesh.parent.iterdir() if file.suffix.lower() in PICTURES)
    named = [file for file in images if file.stem.lower() == mesh.stem.lower()]
    return named[0] if named else images[0] if len(images) == 1 else None


def load_beside(folder: Path, name: str) -> bytes:
    """The bytes of an image in the mesh's folder. Raises FileNotFoundError with the mesh's name for it."""
    try:
        return read_file(inside(folder, name))
    except FileNotFoundError as fault:
        raise FileNotFoundError(fault.errno, fault.strerror, name) from fault


Reader = Callable[[Path], Contents]
READERS: dict[str, Reader] = {".obj": _read_obj, ".glb": _read_gltf, ".gltf": _read_gltf, ".ply": _read_ply}
