"""The file formats: each reader turns a file into `Contents`, and judges nothing.

`flx.assets.formats.gltf`, `obj`, `mtl` and `ply` take the files apart; here the images that a mesh names are
looked up, and decoded by the caller. Texture coordinates run right and down in what is returned, whatever
the format.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64, UInt8

from flx.assets.formats import gltf
from flx.assets.formats.files import BadFile, found_beside, inside, is_there, read_file, substitution
from flx.assets.formats.gltf import Gltf
from flx.assets.formats.mtl import Mapped, parse_mtl
from flx.assets.formats.obj import parse_obj
from flx.assets.formats.obj_source import ObjSource, find_maps, read_libraries
from flx.assets.formats.parts import Material, Part
from flx.assets.formats.ply import parse_ply
from flx.geometry.color import srgb
from flx.types import SLOTS, Slot

Picture = UInt8[Any, "H W C"]  # an image that was given as an array: RGB, or RGBA


class Contents(NamedTuple):
    """A file, read but not yet judged."""

    parts: list[Part]
    materials: list[Material]
    load_image: Callable[[str], bytes | Picture]
    hint: str  # where a texture was looked for
    container: Gltf | ObjSource | None
    missing_images: tuple[str, ...]
    polygons: int = 0  # faces of more than three corners, cut
    ignored_options: tuple[str, ...] = ()  # of map_Kd
    unread: tuple[str, ...] = ()  # what else a PLY has
    found_images: tuple[str, ...] = ()  # under another name than the file's
    slot_uvs: Callable[[Part, Slot], Float64[Any, "V 2"] | None] = lambda part, _: part.uvs


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
        materials.append(Material(name, _base_color(entry), base, maps=names, flat=flat))
    materials.append(Material("default", (1.0, 1.0, 1.0), None))
    return Contents(
        parts=gltf.parts(container),
        materials=materials,
        load_image=lambda name: gltf.image_bytes(container, int(name.rpartition("#")[2])),
        hint="no material has a base colour texture",
        container=container,
        missing_images=tuple(i.get("uri", "an image without data") for i in images if "bufferView" not in i),
        found_images=container.substitutions,
        slot_uvs=partial(gltf.slot_uvs, container),
    )


def _base_color(material: dict) -> tuple[float, float, float]:
    """The flat colour of a material, in sRGB."""
    r, g, b = srgb(np.array(material.get("pbrMetallicRoughness", {}).get("baseColorFactor", [1, 1, 1])[:3]))
    return float(r), float(g), float(b)


def _flat_values(material: dict) -> dict[Slot, tuple[float, float, float]]:
    """What a material has all over in slots other than its base colour; what is no number is left out."""
    pbr = material.get("pbrMetallicRoughness", {})
    factors = [1.0, pbr.get("roughnessFactor", 1), pbr.get("metallicFactor", 1)]
    said: dict[Slot, Any] = {"metallic_roughness": factors, "emissive": material.get("emissiveFactor")}
    values: dict[Slot, tuple[float, float, float]] = {}
    for slot, rows in said.items():
        if isinstance(rows, list) and len(rows) == 3 and all(isinstance(x, int | float) for x in rows):
            r, g, b = srgb(np.array(rows)) if slot == "emissive" else rows
            values[slot] = (float(r), float(g), float(b))
    return values


def _read_obj(path: Path) -> Contents:
    content = read_file(path)
    if b"\0" in content:
        raise BadFile("not a text, as an OBJ file is; export it again")
    obj = parse_obj(content.decode("utf-8-sig", errors="replace"), path.stem)
    libraries, lost, renames = read_libraries(path.parent, content)
    maps, missing = find_maps(path.parent, libraries)
    defined: dict[str, Mapped] = {}
    for library in libraries.values():
        defined |= parse_mtl(library)
    hint = "no map_Kd in the material file" if libraries else "no material file, mtllib, is named"
    white = Mapped(Material(path.stem, (1.0, 1.0, 1.0), None))
    named = [defined.get(n, white._replace(material=white.material._replace(name=n))) for n in obj.names]
    mapped = [*named, white]
    return Contents(
        parts=[_moved(part, mapped[part.material]) for part in obj.parts],
        materials=[each.material for each in mapped],
        load_image=partial(load_beside, path.parent),
        hint=f"{path.parent / lost[-1]} does not exist" if lost else hint,
        container=ObjSource(path.parent, content, libraries, maps, obj.rows, obj.colors),
        missing_images=tuple(missing),
        polygons=obj.polygons,
        found_images=tuple(map(substitution, renames.items())),
        ignored_options=tuple(f"{m.material.name}: {option}" for m in mapped for option in m.options),
        slot_uvs=lambda part, slot: _obj_uvs(part, mapped[part.material], slot),
    )


def _obj_uvs(part: Part, mapped: Mapped, slot: Slot) -> Float64[Any, "V 2"] | None:
    """Raises BadFile for a map of another slot that is not read: of roughness, or moved otherwise."""
    name = mapped.material.name
    if slot == "metallic_roughness" and slot in mapped.material.maps:
        raise BadFile(f"map_Pr and map_Pm of {name!r} are not read; convert the mesh to GLB")
    still = (mapped.scale, mapped.offset) == ((1.0, 1.0), (0.0, 0.0))
    if slot in mapped.material.maps and (slot in mapped.moved or not still):
        raise BadFile(f"the {slot} map of {name!r} and its map_Kd have -s or -o; convert the mesh to GLB")
    return part.uvs


def _moved(part: Part, mapped: Mapped) -> Part:
    """The part with its texture coordinates as `-s` and `-o` of its image place them; v runs up there."""
    if part.uvs is None or (mapped.scale, mapped.offset) == ((1.0, 1.0), (0.0, 0.0)):
        return part
    flip = [1, -1] * part.uvs + [0, 1]
    return part._replace(uvs=(flip * mapped.scale + mapped.offset) * [1, -1] + [0, 1])


def _read_ply(path: Path) -> Contents:
    ply = parse_ply(read_file(path), path.stem)
    renames = {
        n: o for n in ply.images if not is_there(path.parent, n) and (o := found_beside(path.parent, n))
    }
    images = [renames.get(name, name) for name in ply.images] or [None]
    return Contents(
        parts=ply.parts,
        materials=[Material(path.stem, (1.0, 1.0, 1.0), image) for image in images],
        load_image=partial(load_beside, path.parent),
        hint="no comment TextureFile",
        container=None,
        missing_images=(),
        polygons=ply.polygons,
        unread=ply.unread,
        found_images=tuple(map(substitution, renames.items())),
    )


def load_beside(folder: Path, name: str) -> bytes:
    """The bytes of an image beside a mesh. Raises FileNotFoundError with the name as the mesh has it."""
    try:
        return read_file(inside(folder, name))
    except FileNotFoundError as fault:
        raise FileNotFoundError(fault.errno, fault.strerror, name) from fault


READERS = {".obj": _read_obj, ".glb": _read_gltf, ".gltf": _read_gltf, ".ply": _read_ply}
