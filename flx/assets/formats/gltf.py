"""The glTF 2.0 container, read whole: its document, its bytes, its triangles.

`Gltf` holds the JSON document as it was read and the bytes of every buffer view; external and `data:` buffers
and images are taken in, so that it can always be written as one self-contained file. Whatever this project
does not use (extras, extensions, animations) passes through untouched.

Our own reader, not trimesh's, for three reasons: a material must be known by its index to be patched,
texture coordinates must be the file's own bits (trimesh's flip rounds them), and `texCoord` sets,
KHR_texture_transform and normalised integers are ignored there. COLOR_0 is linear light in the file
(glTF 2.0, section 3.7.2.1), sRGB here. `flx.assets.formats.glb` patches and writes.
"""

import base64
import errno
import json
import struct
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote, unquote, unquote_to_bytes

import numpy as np
from jaxtyping import Float32, Float64, Int, Num

from flx.assets.formats.files import (
    BadFile,
    check_faces,
    found_beside,
    inside,
    limit,
    read_file,
    substitution,
)
from flx.assets.formats.parts import Part
from flx.assets.formats.schema import check_document
from flx.geometry.color import srgb
from flx.types import Slot

COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
KINDS = {b"\x89PN": "png", b"\xff\xd8\xff": "jpeg", b"RIF": "webp", b"\xabKT": "ktx2"}  # by the first bytes
IN_PBR = ("base_color", "metallic_roughness")  # slots that lie in pbrMetallicRoughness
TRIANGLES, STRIP, FAN = 4, 5, 6
MOST_VALUES = 1 << 22  # in the JSON: an empty list of three bytes takes a hundred in memory
MOST_PARTS = 1 << 14
MOVES = {"rotation", "scale", "translation"}
UNMOVED = np.eye(4)


View = bytes | memoryview


class Gltf(NamedTuple):
    """A glTF file with all its bytes; `document["bufferViews"][i]` describes `views[i]`."""

    document: dict
    views: tuple[View, ...]
    substitutions: tuple[str, ...] = ()  # images that were found under another name than the file's


# ---------------------------------------------------------------------------------------------- reading


def read_gltf(path: Path) -> Gltf:
    """GLB or glTF, told apart by their first bytes. Images that cannot be found keep their `uri`.

    Raises BadFile for compressed geometry, a broken or missing buffer, and whatever `check_document` finds.
    """
    data = read_file(path)
    text, chunk = _chunks(data) if data[:4] == b"glTF" else (data, b"")
    if (values := sum(text.count(mark) for mark in (b",", b"[", b"{"))) > MOST_VALUES:
        raise BadFile(f"its JSON has {values:,} values, more than {MOST_VALUES:,}; export it without extras")
    try:
        document = json.loads(text.decode("utf-8-sig"))
    except (ValueError, RecursionError) as fault:
        raise BadFile(f"its JSON is broken ({str(fault)[:80]}); export it again") from fault
    check_document(document)
    held: dict[str, bytes] = {}  # what is named more than once is held once

    def fetch(uri: str) -> bytes:
        return held[uri] if uri in held else held.setdefault(uri, _resource(uri, path.parent))

    try:
        buffers = [_buffer(i, b, chunk, fetch) for i, b in enumerate(document.get("buffers", []))]
        views: list[View] = [_view(i, v, buffers) for i, v in enumerate(document.get("bufferViews", []))]
    except KeyError as fault:
        raise BadFile(f"a buffer or buffer view has no {fault}; export it again") from fault
    substitutions = []
    for image in document.get("images", []):
        if "uri" not in image:
            continue
        name = unquote(image["uri"])
        other = "" if image["uri"].startswith("data:") else found_beside(path.parent, name)
        substitutions += [substitution((name, other))] if other else []
        try:
            content = fetch(quote(other) or image["uri"])
        except FileNotFoundError:
            continue
        kind = KINDS.get(content[:3])
        image["mimeType"] = f"image/{kind}" if kind else image.get("mimeType", "image/png")
        image["bufferView"] = append_view(document, views, content)
        del image["uri"]
    _check_overlap(views, sum(map(len, (chunk, *held.values()))))
    return Gltf(document, tuple(views), tuple(substitutions))


def _chunks(data: bytes) -> tuple[bytes, bytes]:
    """The JSON and the binary chunk of a GLB."""
    version, total = struct.unpack_from("<II", data, 4) if len(data) >= 12 else (0, 12)
    if version != 2 or not 12 <= total <= len(data):
        raise BadFile(f"GLB version {version}, {len(data)} of {total} bytes; export it again as glTF 2.0")
    chunks, at = {}, 12
    while at + 8 <= total:
        length, kind = struct.unpack_from("<I4s", data, at)
        if at + 8 + length > total:
            raise BadFile(f"a chunk of {length:,} bytes ends past the file; export it again")
        chunks.setdefault(kind, data[at + 8 : at + 8 + length])
        at += 8 + length
    if b"JSON" not in chunks:
        raise BadFile("a GLB without a JSON chunk; export it again")
    return chunks[b"JSON"], chunks.get(b"BIN\0", b"")


def _buffer(index: int, buffer: dict, chunk: bytes, fetch: Callable[[str], bytes]) -> bytes:
    content = fetch(buffer["uri"]) if "uri" in buffer else chunk
    if len(content) < buffer["byteLength"]:
        sizes = f"{len(content):,} bytes of {buffer['byteLength']:,}"
        raise BadFile(f"buffer {index} has {sizes}; export it again")
    return content


def _view(index: int, view: dict, buffers: list[bytes]) -> memoryview:
    start, length = view.get("byteOffset", 0), view["byteLength"]
    if start + length > len(buffers[view["buffer"]]):
        raise BadFile(f"buffer view {index} ends past its buffer; export it again")
    return memoryview(buffers[view["buffer"]])[start : start + length]


def _check_overlap(views: Sequence[View], there: int) -> None:
    """Raises BadFile where views show the same bytes too often: each is decoded and written on its own."""
    if (excess := sum(map(len, views)) - there) > limit("FLX_MAX_BYTES"):
        what = f"{len(views):,} buffer views of {there:,} bytes overlap by {excess:,}"
        raise BadFile(f"{what}; export it again, or set FLX_MAX_BYTES={excess}")


def _resource(uri: str, folder: Path) -> bytes:
    """The bytes behind a URI: `data:`, or a file in the folder of the asset. Never the network."""
    if not uri.startswith("data:"):
        return read_file(inside(folder, unquote(uri)))
    head, _, body = uri.partition(",")
    try:
        return base64.b64decode(body, validate=True) if head.endswith(";base64") else unquote_to_bytes(body)
    except ValueError as fault:
        raise BadFile(f"the data URI {uri[:40]!r} is broken ({fault}); export it again") from fault


def append(document: dict, key: str, entry: dict) -> int:
    """Adds an entry to one of the document's lists and returns its index."""
    document.setdefault(key, []).append(entry)
    return len(document[key]) - 1


def append_view(document: dict, views: list[View], content: bytes) -> int:
    """Adds a buffer view; its offset is set when the file is written."""
    views.append(content)
    return append(document, "bufferViews", {"buffer": 0, "byteLength": len(content)})


def accessor(gltf: Gltf, index: int) -> Num[Any, "N C"]:
    """The rows of an accessor in their own dtype, sparse ones filled in; normalised integers as float32.

    Raises BadFile where it has no data, or more rows than its bytes can hold.
    """
    entry = gltf.document["accessors"][index]
    if not {"type", "count", "componentType"} <= entry.keys() or entry["type"] not in WIDTHS:
        raise BadFile(f"accessor {index} holds {entry.get('type')!r} rows; export it again")
    width, count, sparse = WIDTHS[entry["type"]], entry["count"], entry.get("sparse")
    if "bufferView" in entry:
        rows = _rows(gltf, entry, entry["componentType"], width, count)
    elif sparse and count <= min(sum(map(len, gltf.views)), 3 * limit("FLX_MAX_FACES")):
        rows = np.zeros((count, width), COMPONENTS[entry["componentType"]])
    else:
        raise BadFile(f"accessor {index} has no data; save the file without compression")
    if sparse:
        if not {"count", "indices", "values"} <= sparse.keys():
            raise BadFile(f"accessor {index} is sparse without data; export it again")
        component = sparse["indices"].get("componentType", 5125)
        where = _rows(gltf, sparse["indices"], component, 1, sparse["count"])
        if where.max() >= count:
            raise BadFile(f"accessor {index} fills row {where.max()} of {count}; export it again")
        rows[where[:, 0]] = _rows(gltf, sparse["values"], entry["componentType"], width, sparse["count"])
    if entry.get("normalized") is True and rows.dtype.kind in "iu":
        rows = np.maximum(rows / np.float32(np.iinfo(rows.dtype).max), -1).astype(np.float32)
    return rows


def _rows(gltf: Gltf, entry: dict, component: int, width: int, count: int) -> Num[Any, "N C"]:
    dtype, view, start = np.dtype(COMPONENTS[component]), entry.get("bufferView"), entry.get("byteOffset", 0)
    if view is None:
        raise BadFile("sparse rows have no buffer view; export the file again")
    size = dtype.itemsize * width
    stride = gltf.document["bufferViews"][view].get("byteStride", size)
    if count < 1 or stride < size or start + (count - 1) * stride + size > len(gltf.views[view]):
        raise BadFile(f"{count} rows do not fit into buffer view {view}; export the file again")
    return np.ndarray((count, width), dtype, gltf.views[view], start, (stride, dtype.itemsize)).copy()


def scene_nodes(document: dict) -> Iterator[tuple[int, Float64[Any, "4 4"]]]:
    """Every node of the default scene, once, with its transform to the scene."""
    nodes, seen = document.get("nodes", []), set()
    children = {child for node in nodes for child in node.get("children", [])}
    scenes = document.get("scenes") or [{"nodes": [i for i in range(len(nodes)) if i not in children]}]
    stack = [(i, UNMOVED) for i in reversed(scenes[document.get("scene", 0)].get("nodes", []))]
    while stack:
        index, parent = stack.pop()
        if index in seen:
            raise BadFile(f"the scene shows node {index} twice; export it again")
        seen.add(index)
        with np.errstate(all="ignore"):  # what grows without bound is refused where a vertex is
            world = parent @ _local_transform(nodes[index])
        yield index, world
        stack.extend((child, world) for child in reversed(nodes[index].get("children", [])))


def _local_transform(node: dict) -> Float64[Any, "4 4"]:
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    if not MOVES & node.keys():
        return UNMOVED
    x, y, z, w = map(float, node.get("rotation", (0, 0, 0, 1)))
    i, j, k = map(float, node.get("scale", (1, 1, 1)))
    right, up, ahead = map(float, node.get("translation", (0, 0, 0)))
    rows = (
        ((1 - 2 * (y * y + z * z)) * i, (2 * (x * y - z * w)) * j, (2 * (x * z + y * w)) * k, right),
        ((2 * (x * y + z * w)) * i, (1 - 2 * (x * x + z * z)) * j, (2 * (y * z - x * w)) * k, up),
        ((2 * (x * z - y * w)) * i, (2 * (y * z + x * w)) * j, (1 - 2 * (x * x + y * y)) * k, ahead),
        (0.0, 0.0, 0.0, 1.0),
    )
    return np.array(rows)


def parts(gltf: Gltf) -> list[Part]:
    """Every triangle primitive of the default scene, in the scene's frame.

    A primitive without a material gets index `len(materials)`, the specification's default. A transform that
    mirrors reverses the faces, so that they stay counter-clockwise. Skins and morph targets are not applied.
    """
    document, parts = gltf.document, []
    materials, read = document.get("materials", []), 0
    for node, world, number, primitive in _triangles(document):
        if len(parts) == MOST_PARTS:
            raise BadFile(f"more than {MOST_PARTS:,} parts; join some")
        mesh = document["nodes"][node]["mesh"]
        attributes = primitive["attributes"]
        points = _attribute(gltf, attributes, "POSITION", (3,)).astype(np.float64)
        faces = _faces(gltf, primitive, len(points))
        material = primitive.get("material", len(materials))
        reference = texture_reference(materials[material]) if "material" in primitive else {}
        with np.errstate(all="ignore"):  # numbers that are not finite are refused by name, later
            points = points @ world[:3, :3].T + world[:3, 3]
            mirrored = np.linalg.det(world[:3, :3]) < 0
        part = Part(
            name=document["meshes"][mesh].get("name", f"mesh {mesh}"),
            material=material,
            positions=points,
            normals=_normals(gltf, attributes, world[:3, :3]),
            uvs=_uvs(gltf, attributes, reference),
            colors=_colors(gltf, attributes),
            faces=faces[:, ::-1].copy() if mirrored else faces,
            origin=(node, number),
        )
        _check_counts(part)
        parts.append(part)
        read += max(len(faces), len(points) // 3)
        check_faces(read)  # a small file can show one mesh very often
    return parts


def _check_counts(part: Part) -> None:
    words = ("normals", "texture coordinates", "colours")
    for rows, what in zip((part.normals, part.uvs, part.colors), words, strict=True):
        if rows is not None and len(rows) != len(part.positions):
            count = f"{len(rows)} {what} for {len(part.positions)} vertices"
            raise BadFile(f"{part.name!r} has {count}; export it again")


def _triangles(document: dict) -> Iterator[tuple[int, Float64[Any, "4 4"], int, dict]]:
    """Node, its transform, index and entry of every triangle primitive in the scene."""
    for node, world in scene_nodes(document):
        mesh = document["nodes"][node].get("mesh")
        primitives = [] if mesh is None else document["meshes"][mesh].get("primitives", [])
        for number, primitive in enumerate(primitives):
            if primitive.get("mode", TRIANGLES) not in (TRIANGLES, STRIP, FAN):
                continue
            if "POSITION" not in primitive.get("attributes", {}):
                raise BadFile(f"primitive {number} of node {node} has no POSITION; export it again")
            yield node, world, number, primitive


def _attribute(gltf: Gltf, attributes: dict, name: str, widths: tuple[int, ...]) -> Num[Any, "N C"]:
    rows = accessor(gltf, attributes[name])
    if rows.shape[1] not in widths:
        raise BadFile(f"{name} has {rows.shape[1]} numbers for a vertex, not {widths[0]}; export it again")
    return rows


def _faces(gltf: Gltf, primitive: dict, points: int) -> Int[Any, "F 3"]:
    mode = primitive.get("mode", TRIANGLES)
    if "indices" in primitive:
        rows = _attribute(gltf, primitive, "indices", (1,))
        if rows.dtype.kind != "u":
            raise BadFile(f"indices are {rows.dtype}, not whole numbers; export it again")
        order = rows[:, 0].astype(np.int64)
    else:
        order = np.arange(points)
    if len(order) < 3 or (mode == TRIANGLES and len(order) % 3):
        raise BadFile(f"{len(order)} indices make no triangles; export it again")
    if mode == TRIANGLES:
        return order.reshape(-1, 3)
    if mode == FAN:
        return np.stack([np.full(len(order) - 2, order[0]), order[1:-1], order[2:]], 1)
    strip = np.stack([order[:-2], order[1:-1], order[2:]], 1)
    strip[1::2, :2] = strip[1::2, 1::-1]
    return strip


def _normals(gltf: Gltf, attributes: dict, world: Float64[Any, "3 3"]) -> Float64[Any, "V 3"] | None:
    """Unit normals under the inverse transpose of a transform; 0 for those without a direction.

    Uses cofactors (the inverse transpose times det), which a singular transform has, too.
    """
    if "NORMAL" not in attributes:
        return None
    x, y, z = world.T
    with np.errstate(all="ignore"):
        turned = np.stack([np.cross(y, z), np.cross(z, x), np.cross(x, y)])
        turned = turned / np.abs(turned).max() * (-1 if np.linalg.det(world) < 0 else 1)
        normals = _attribute(gltf, attributes, "NORMAL", (3,)).astype(np.float64) @ turned
        return np.nan_to_num(normals / np.linalg.norm(normals, axis=1, keepdims=True), posinf=0, neginf=0)


def slot_uvs(gltf: Gltf, part: Part, slot: Slot) -> Float64[Any, "V 2"] | None:
    """The coordinates at which a part reads the image of a slot, which may differ from `Part.uvs`."""
    if slot == "base_color":
        return part.uvs
    node, number = part.origin
    mesh = gltf.document["meshes"][gltf.document["nodes"][node]["mesh"]]
    materials = gltf.document.get("materials", [])
    material = materials[part.material] if part.material < len(materials) else {}
    uvs = _uvs(gltf, mesh["primitives"][number]["attributes"], texture_reference(material, slot))
    _check_counts(part._replace(uvs=uvs))
    return uvs


def _uvs(gltf: Gltf, attributes: dict, reference: dict) -> Float64[Any, "V 2"] | None:
    """The coordinates a texture is read at: its own set, under KHR_texture_transform."""
    transform = reference.get("extensions", {}).get("KHR_texture_transform", {})
    name = f"TEXCOORD_{transform.get('texCoord', reference.get('texCoord', 0))}"
    if name not in attributes:
        return None
    u, v = (_attribute(gltf, attributes, name, (2,)).astype(np.float64) * transform.get("scale", [1, 1])).T
    c, s = np.cos(transform.get("rotation", 0)), np.sin(transform.get("rotation", 0))
    return np.stack([c * u + s * v, c * v - s * u], 1) + transform.get("offset", [0, 0])


def _colors(gltf: Gltf, attributes: dict) -> Float32[Any, "V 3"] | None:
    if "COLOR_0" not in attributes:
        return None
    return srgb(_attribute(gltf, attributes, "COLOR_0", (3, 4))[:, :3]).astype(np.float32)


def texture_key(slot: Slot) -> str:
    """glTF's key for the texture of a slot, such as baseColorTexture."""
    first, *others = slot.split("_")
    return first + "".join(map(str.title, others)) + "Texture"


def texture_reference(material: dict, slot: Slot = "base_color") -> dict:
    """How a material refers to the texture of a slot; empty where it has none."""
    holder = material.get("pbrMetallicRoughness", {}) if slot in IN_PBR else material
    gloss = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness", {})
    diffuse = gloss.get("diffuseTexture") if slot == "base_color" else None
    return holder.get(texture_key(slot)) or diffuse or {}


def texture_image(document: dict, texture: int) -> int:
    """The image of a texture: that of EXT_texture_webp, else its source; −1 without either."""
    entry = document["textures"][texture]
    webp = entry.get("extensions", {}).get("EXT_texture_webp", {})
    return webp.get("source", entry.get("source", -1))


def image_bytes(gltf: Gltf, image: int) -> bytes:
    """The encoded image. Raises FileNotFoundError naming the file where it was not found."""
    entry = gltf.document["images"][image]
    if "bufferView" not in entry:
        raise FileNotFoundError(errno.ENOENT, "not found", entry.get("uri", "an image without data"))
    return bytes(gltf.views[entry["bufferView"]])
