"""Writes GLB files: a glTF that was read, with the images of a slot replaced; or a new one from triangles.

A file that was read is patched, never rebuilt: accessors, other maps, names, extras and transforms keep their
index and their bytes. Every file is self-contained.
"""

import json
import struct
from collections.abc import Container, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Num

from flx.assets.formats.gltf import (
    IN_PBR,
    WIDTHS,
    Gltf,
    View,
    accessor,
    append,
    append_view,
    texture_image,
    texture_key,
    texture_reference,
)
from flx.assets.formats.parts import Paint, Part
from flx.geometry.arrays import mark
from flx.geometry.color import linear
from flx.types import Slot

FLOAT, UNSIGNED = 5126, 5125
COARSEST = 1e-6  # rounding of positions, as a share of the size of a mesh, from which they are moved


def replace_images(gltf: Gltf, slot: Slot, textures: Mapping[int, int], pngs: Mapping[int, bytes]) -> Gltf:
    """The same file with other images in one slot: material m shows `pngs[textures[m]]`.

    An image that only this slot uses is replaced in place. One that another slot uses too stays, and the
    material gets a new image and texture; so do a material that has none, and primitives without a material
    (key `len(materials)`). Everything else keeps its place and its bytes.
    """
    document, views = _copy(gltf.document), list(gltf.views)
    materials = document.setdefault("materials", [])
    if len(materials) in textures:
        default = append(document, "materials", {"name": "default"})
        for mesh in document["meshes"]:
            for primitive in mesh["primitives"]:
                primitive.setdefault("material", default)
    references = [texture_reference(material, slot) for material in materials]
    shared = _images_of_other_slots(document, references)
    words = slot.replace("_", " ")
    new: dict[int, int] = {}
    for material, number in textures.items():
        reference, png = references[material], pngs[number]
        texture = reference.get("index", -1)
        image = texture_image(document, texture) if texture >= 0 else -1
        if image in shared or image < 0:
            if number not in new:
                name = document["images"][image].get("name", words) if image >= 0 else words
                new[number] = append(document, "images", {"name": name})
                _put_image(document, views, new[number], png)
            entry = dict(document["textures"][texture]) if texture >= 0 else {}
            texture = append(document, "textures", entry)
            image = new[number]
            if not reference:
                reference = _holder(materials[material], slot).setdefault(texture_key(slot), {})
            reference["index"] = texture
        else:
            _put_image(document, views, image, png)
        _show(document, texture, image)
    return Gltf(document, tuple(views))


def untinted(gltf: Gltf) -> Gltf:
    """The same file without what multiplies a base colour: factors (alpha stays) and vertex colours.

    Primitives without a material get one that is not metallic.
    """
    document = _copy(gltf.document)
    materials = document.setdefault("materials", [])
    primitives = [primitive for mesh in document.get("meshes", []) for primitive in mesh["primitives"]]
    if any("material" not in primitive for primitive in primitives):
        plain = {"name": "default", "pbrMetallicRoughness": {"metallicFactor": 0.0}}
        default = append(document, "materials", plain)
        for primitive in primitives:
            primitive.setdefault("material", default)
    for primitive in primitives:
        primitive["attributes"].pop("COLOR_0", None)
    for material in materials:
        gloss = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness", {})
        for holder in (material.get("pbrMetallicRoughness", {}), gloss):
            for key in {"baseColorFactor", "diffuseFactor"} & holder.keys():
                holder[key] = [1.0, 1.0, 1.0, holder[key][3]]
    return Gltf(document, gltf.views)


def _holder(material: dict, slot: Slot) -> dict:
    """The object of a material that refers to the texture of a slot."""
    return material.setdefault("pbrMetallicRoughness", {}) if slot in IN_PBR else material


def replace_colors(gltf: Gltf, colors: Mapping[tuple[int, int], Float32[Any, "_ 3"]]) -> Gltf:
    """The same file with other vertex colours (sRGB): {(node, primitive): colours}; their alpha is kept.

    A mesh that several nodes show is written once for each of them, since each has colours of its own.
    """
    document, views = _copy(gltf.document), list(gltf.views)
    mesh_of, taken = {}, set()
    for (node, number), color in colors.items():
        if node not in mesh_of:
            mesh = document["nodes"][node]["mesh"]
            if mesh in taken:
                mesh = append(document, "meshes", _copy(gltf.document["meshes"][mesh]))
                document["nodes"][node]["mesh"] = mesh
            taken.add(mesh)
            mesh_of[node] = mesh
        attributes = document["meshes"][mesh_of[node]]["primitives"][number]["attributes"]
        rows = linear(color).astype(np.float32)
        old = accessor(gltf, attributes["COLOR_0"]) if "COLOR_0" in attributes else rows
        if old.shape[1] == 4:
            alpha = old[:, 3:] / (1 if old.dtype.kind == "f" else np.iinfo(old.dtype).max)
            rows = np.concatenate([rows, alpha.astype(np.float32)], 1)
        attributes["COLOR_0"] = _append_rows(document, views, rows)
    return Gltf(document, tuple(views))


def _copy(document: dict) -> dict:
    return json.loads(json.dumps(document))  # `deepcopy` is slower, and fails on deep nesting


def _append_rows(document: dict, views: list[View], rows: Num[Any, "N C"]) -> int:
    """An accessor over float32 rows or uint32 scalars, with the bounds that positions must have."""
    component = FLOAT if rows.dtype == np.float32 else UNSIGNED
    kind = {width: name for name, width in WIDTHS.items()}[rows.shape[1]]
    entry = {"bufferView": append_view(document, views, rows.tobytes()), "componentType": component}
    entry |= {"count": len(rows), "type": kind, "min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
    return append(document, "accessors", entry)


def _images_of_other_slots(document: dict, references: Sequence[dict]) -> set[int]:
    """The images that other references than these use: their pixels must stay."""
    own, images = set(map(id, references)), set()

    def visit(value: Any, key: str = "") -> None:
        if isinstance(value, dict):
            if key.endswith("Texture") and id(value) not in own and "index" in value:
                images.add(texture_image(document, value["index"]))
            for name, child in value.items():
                visit(child, name)
        elif isinstance(value, list):
            for child in value:
                visit(child)

    visit(document.get("materials", []))
    return images


def other_images(gltf: Gltf) -> list[str]:
    """The names of the images that a file uses for anything but base colours."""
    document = gltf.document
    base = [texture_reference(material) for material in document.get("materials", [])]
    images = document.get("images", [])
    others = sorted(i for i in _images_of_other_slots(document, base) if i >= 0)
    return [str(images[i].get("name") or images[i].get("uri") or f"image {i}") for i in others]


def missing_images(gltf: Gltf, painted: Container[int] = ()) -> list[str]:
    """The files of missing images, except those that new base colours of the `painted` materials replace."""
    document = gltf.document
    base = [texture_reference(material) for material in document.get("materials", [])]
    shown = [base[m]["index"] for m in range(len(base)) if m in painted and "index" in base[m]]
    new = {texture_image(document, i) for i in shown} - _images_of_other_slots(document, base)
    lost = [i for i, image in enumerate(document.get("images", [])) if "bufferView" not in image]
    return [document["images"][i].get("uri", "an image without data") for i in lost if i not in new]


def _put_image(document: dict, views: list[View], image: int, png: bytes) -> None:
    """Puts the PNG in the image's place; its buffer view is reused if nothing else uses it."""
    entry = document["images"][image]
    readers = [other.get("bufferView") for other in document["images"]]
    readers += [other.get("bufferView") for other in document.get("accessors", [])]
    if readers.count(entry.get("bufferView")) == 1 and "bufferView" in entry:
        views[entry["bufferView"]] = png
    else:
        entry["bufferView"] = append_view(document, views, png)
    entry.pop("uri", None)
    entry["mimeType"] = "image/png"


def _show(document: dict, texture: int, image: int) -> None:
    """Makes the texture show the image as PNG, not as the kinds of its extensions."""
    entry = document["textures"][texture]
    entry["source"] = image
    extensions = entry.pop("extensions", {})
    remaining = {k: v for k, v in extensions.items() if k not in ("EXT_texture_webp", "KHR_texture_basisu")}
    if remaining:
        entry["extensions"] = remaining


def build_gltf(
    name: str,
    parts: Sequence[Part],
    paints: Sequence[Paint],
    pngs: Mapping[Slot, Mapping[int, bytes]],
    colors: Sequence[Float32[Any, "_ 3"]] | None = None,
) -> Gltf:
    """A new file for triangles from another format: one mesh, with a primitive for each part.

    `pngs` holds the images of `Paint.textures`; `colors` are sRGB, one array for each part. Materials are not
    metallic and fully rough, since a scan's lighting is in its texture, and double-sided, since OBJ and PLY
    have no culling. Unused materials are left out.
    """
    document: dict = {"asset": {"version": "2.0", "generator": "flx"}, "scene": 0, "scenes": [{"nodes": [0]}]}
    origin = _origin(parts)
    node = {"mesh": 0, "name": name} | ({"translation": origin.tolist()} if origin.any() else {})
    document |= {"nodes": [node], "meshes": [{"name": name, "primitives": []}]}
    views: list[View] = []
    images: dict[tuple[Slot, int], int] = {}
    for slot, of_slot in pngs.items():
        for texture, png in of_slot.items():
            number = images[slot, texture] = append(document, "textures", {"source": len(images)})
            append(document, "images", {"name": f"{slot.replace('_', ' ')} {texture}"})
            _put_image(document, views, number, png)
    number_of: dict[int, int] = {}
    for number in sorted({part.material for part in parts}):
        paint = paints[number]
        pbr: dict = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
        material = {"name": paint.name, "pbrMetallicRoughness": pbr, "doubleSided": True}
        for slot, texture in paint.textures.items():
            if (slot, texture) in images:
                _holder(material, slot)[texture_key(slot)] = {"index": images[slot, texture]}
                if slot == "emissive":
                    material["emissiveFactor"] = [1.0, 1.0, 1.0]  # multiplies the image; 0 by default
        color = [1.0, 1.0, 1.0]
        if ("base_color", paint.texture) not in images and colors is None:
            color = linear(np.array(paint.color)).tolist()
        if [*color, paint.opacity] != [1.0] * 4:
            pbr["baseColorFactor"] = [*color, paint.opacity]
        if paint.alpha_mode != "OPAQUE":
            material["alphaMode"] = paint.alpha_mode
        number_of[number] = append(document, "materials", material)
    for i, part in enumerate(parts):
        rows = {"POSITION": part.positions - origin, "NORMAL": part.normals, "TEXCOORD_0": part.uvs}
        rows["COLOR_0"] = None if colors is None else linear(colors[i])
        attributes = {
            key: _append_rows(document, views, np.ascontiguousarray(value, np.float32))
            for key, value in rows.items()
            if value is not None
        }
        indices = _append_rows(document, views, part.faces.reshape(-1, 1).astype(np.uint32))
        primitive = {"attributes": attributes, "indices": indices, "material": number_of[part.material]}
        document["meshes"][0]["primitives"].append(primitive)
    return Gltf(document, tuple(views))


def _origin(parts: Sequence[Part]) -> Float64[Any, "3"]:
    """Where positions are counted from: 0, or the middle of a mesh so far off that float32 is too coarse."""
    ends = []
    for part in parts:
        used = part.positions[mark(len(part.positions), part.faces)]
        ends += [used.min(0), used.max(0)]
    low, high = np.min(ends, 0), np.max(ends, 0)
    step = np.maximum(np.abs(low), np.abs(high)).max() * np.finfo(np.float32).eps
    return (low + high) / 2 if step > COARSEST * (high - low).max() else np.zeros(3)


def glb_bytes(gltf: Gltf) -> bytes:
    """One GLB: the views in order, each aligned to four bytes as accessors require."""
    document, binary = _copy(gltf.document), bytearray()
    for entry, view in zip(document.get("bufferViews", []), gltf.views, strict=True):
        entry |= {"buffer": 0, "byteOffset": len(binary), "byteLength": len(view)}
        binary += view
        binary += bytes(-len(view) % 4)
    document["buffers"] = [{"byteLength": len(binary)}]
    text = json.dumps(document, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
