"""A glTF scene of all that a container may hold, and what stays the same in it."""

import copy
import io
import json

import numpy as np
from PIL import Image

from flx.assets.formats.glb import glb_bytes
from flx.assets.formats.gltf import Gltf
from flx.files import write_atomically


def png(color, size=(8, 4), alpha=None) -> bytes:
    image = Image.new("RGB", size, color)
    if alpha is not None:
        image.putalpha(Image.new("L", size, alpha))
    content = io.BytesIO()
    image.save(content, format="PNG")
    return content.getvalue()


def container(occlusion_shares: bool = False) -> Gltf:
    """Two materials, three images, extras, names, transformed nodes, a normal map, a line primitive."""
    rng = np.random.default_rng(0)
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    uvs = rng.uniform(size=(4, 2)).astype(np.float32)
    faces = np.array([0, 1, 2, 0, 2, 3], np.uint16)
    views = [points.tobytes(), uvs.tobytes(), faces.tobytes()]
    views += [png((200, 10, 10), alpha=90), png((10, 200, 10)), png((128, 128, 255))]
    document = {
        "asset": {"version": "2.0", "generator": "hand", "extras": {"é": [1, 2.5, None]}},
        "scene": 0,
        "scenes": [{"nodes": [0], "name": "scene"}],
        "nodes": [
            {"name": "root", "children": [1], "translation": [1, 2, 3], "scale": [2, 2, 2]},
            {"name": "leaf", "mesh": 0, "rotation": [0, 0, np.sqrt(0.5), np.sqrt(0.5)], "extras": {"a": 1}},
        ],
        "meshes": [
            {
                "name": "quad",
                "primitives": [
                    {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": i}
                    for i in (0, 1)
                ]
                + [{"attributes": {"POSITION": 0}, "indices": 2, "mode": 1}],
            }
        ],
        "materials": [
            {
                "name": "red",
                "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "baseColorFactor": [0.5, 1, 1, 1]},
                "normalTexture": {"index": 2, "scale": 0.5},
                "alphaMode": "BLEND",
            },
            {"name": "green", "pbrMetallicRoughness": {"baseColorTexture": {"index": 1}}, "extras": "kept"},
        ],
        "textures": [{"source": i, "sampler": 0} for i in range(3)],
        "samplers": [{"wrapS": 33071}],
        "images": [{"bufferView": 3 + i, "mimeType": "image/png", "name": f"image {i}"} for i in range(3)],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": 5126,
                "count": 4,
                "type": "VEC3",
                "min": [0] * 3,
                "max": [1, 1, 0],
            },
            {"bufferView": 1, "componentType": 5126, "count": 4, "type": "VEC2"},
            {"bufferView": 2, "componentType": 5123, "count": 6, "type": "SCALAR"},
        ],
        "bufferViews": [{"buffer": 0, "byteLength": len(view)} for view in views],
    }
    if occlusion_shares:
        document["materials"][1]["occlusionTexture"] = {"index": 1}
    return Gltf(document, tuple(views))


def save(gltf: Gltf, path):
    write_atomically(path, glb_bytes(gltf))
    return path


def save_external(gltf: Gltf, folder):
    """The same file as .gltf, a .bin with an offset, and images beside it."""
    document, binary = copy.deepcopy(gltf.document), b"\0" * 8
    for i, image in enumerate(document["images"]):
        (folder / f"im age{i}.png").write_bytes(gltf.views[image.pop("bufferView")])
        image["uri"] = f"im%20age{i}.png"
    document["bufferViews"] = document["bufferViews"][:3]
    for entry, view in zip(document["bufferViews"], gltf.views, strict=False):
        entry["byteOffset"] = len(binary)
        binary += view + b"\0" * (-len(view) % 4)
    (folder / "data.bin").write_bytes(binary)
    document["buffers"] = [{"byteLength": len(binary), "uri": "data.bin"}]
    (folder / "a.gltf").write_text(json.dumps(document))
    return folder / "a.gltf"


def without_storage(document: dict) -> dict:
    """The document, less what says where bytes lie."""
    document = copy.deepcopy(document)
    for key in ("buffers", "bufferViews"):
        document.pop(key, None)
    for image in document.get("images", []):
        for key in ("bufferView", "uri", "mimeType"):
            image.pop(key, None)
    return document
