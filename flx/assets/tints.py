"""Factors that viewers multiply a base colour texture by, and a mesh as they show it."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int

from flx.assets.asset import Asset
from flx.assets.formats.gltf import Gltf
from flx.geometry.color import linear, quantized, srgb
from flx.types import TexturedMesh


class Tint(NamedTuple):
    """A material whose texture is multiplied, in linear light."""

    material: int
    name: str
    factor: tuple[float, float, float]


def tints(asset: Asset) -> list[Tint]:
    """The tinted materials in use; an asset that was not glTF has none (viewers differ on Kd)."""
    if not isinstance(asset.container, Gltf):
        return []
    found = []
    for material in sorted({part.material for part in asset.parts}):
        entries = asset.container.document.get("materials", [])
        entry = entries[material] if material < len(entries) else {}
        factor = entry.get("pbrMetallicRoughness", {}).get("baseColorFactor", [1, 1, 1, 1])[:3]
        paint = asset.paints[material]
        painted = paint.texture >= 0 and not asset.textures[paint.texture].flat
        if painted and factor != [1, 1, 1]:
            found.append(Tint(material, paint.name, (factor[0], factor[1], factor[2])))
    return found


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
