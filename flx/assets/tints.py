"""What viewers multiply a base colour texture by, and a mesh as they show it.

In glTF that is a factor of the material and the colours of vertices, and every viewer does it. Of an OBJ or a
PLY some viewers do, others do not: there it is told, and pictures show what flx writes as a GLB, without.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32, Int

from flx.assets.asset import Asset
from flx.assets.formats.gltf import Gltf
from flx.assets.formats.parts import Part
from flx.geometry.color import linear, quantized, srgb
from flx.types import TexturedMesh


class Tint(NamedTuple):
    """A material whose texture is multiplied, in linear light."""

    material: int
    name: str
    factor: tuple[float, float, float]


def tints(asset: Asset) -> list[Tint]:
    """The materials in use with a factor; an asset that was not glTF has none."""
    if not isinstance(asset.container, Gltf):
        return []
    found = []
    for material in sorted({part.material for part in asset.parts}):
        entries = asset.container.document.get("materials", [])
        entry = entries[material] if material < len(entries) else {}
        factor = entry.get("pbrMetallicRoughness", {}).get("baseColorFactor", [1, 1, 1, 1])[:3]
        if _has_image(asset, material) and factor != [1, 1, 1]:
            found.append(Tint(material, asset.paints[material].name, (factor[0], factor[1], factor[2])))
    return found


def corner_tints(asset: Asset) -> Float32[Any, "F 3 3"] | None:
    """The colours of vertices that multiply the textures of a glTF, at the corners of faces, in linear light.

    None where there are none.
    """
    if not (isinstance(asset.container, Gltf) and asset.textures and any(map(_is_colored, asset.parts))):
        return None
    rows = [np.ones((len(p.positions), 3)) if p.colors is None else linear(p.colors) for p in asset.parts]
    return np.concatenate(rows)[asset.corner_vertices].astype(np.float32)


def tints_in_words(asset: Asset) -> list[str]:
    """Each material with an image, and what viewers multiply it by."""
    found = [f"{tint.name} × {_numbers(tint.factor)}" for tint in tints(asset)]
    in_gltf = isinstance(asset.container, Gltf)
    for material in sorted({part.material for part in asset.parts if _has_image(asset, part.material)}):
        paint, where = asset.paints[material], "" if in_gltf else " (some viewers)"
        if not in_gltf and paint.color != (1, 1, 1):
            found.append(f"{paint.name} × Kd {_numbers(paint.color)}{where}")
        if any(part.material == material and _is_colored(part) for part in asset.parts):
            found.append(f"{paint.name} × the colours of its vertices{where}")
    return found


def _has_image(asset: Asset, material: int) -> bool:
    texture = asset.paints[material].texture
    return texture >= 0 and not asset.textures[texture].flat


def _is_colored(part: Part) -> bool:
    return part.colors is not None and bool((part.colors != 1).any())


def _numbers(color: Sequence[float | int]) -> str:
    return " ".join(f"{x:.3g}" for x in color)


def tinted(asset: Asset, mesh: TexturedMesh) -> TexturedMesh:
    """A mesh of the asset, in its own or new colours, as viewers show it: textures times factors."""
    images, face_images = list(mesh.textures), mesh.face_textures.copy()
    for tint in tints(asset):
        faces = face_materials(asset) == tint.material
        for index in np.unique(mesh.face_textures[faces]):
            colors = linear(mesh.textures[index] / np.iinfo(mesh.textures[index].dtype).max)
            face_images[faces & (mesh.face_textures == index)] = len(images)
            images.append(quantized(srgb(colors * tint.factor), mesh.textures[index].dtype))
    return mesh.with_layer(images=tuple(images), face_images=face_images)


def face_materials(asset: Asset) -> Int[Any, "F"]:
    """The material of each face of the asset's mesh."""
    counts = [len(part.positions) for part in asset.parts]
    return np.repeat([part.material for part in asset.parts], counts)[asset.corner_vertices[:, 0]]
