"""One GLB with many paintings of an asset: geometry once, and a variant of the materials for each."""

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from flx.assets.asset import Asset, Format, Painting
from flx.assets.formats import glb
from flx.assets.formats.gltf import Gltf, append, append_view, texture_reference
from flx.assets.write import encoded, painted_gltf
from flx.files import write_atomically

EXTENSION = "KHR_materials_variants"


def check_variants(asset: Asset, format: Format) -> None:
    """Raises ValueError where paintings of the asset cannot be variants of one file."""
    if format != "glb":
        raise ValueError(f"variants are for a GLB, not for {format}; leave out --format or --variants")
    if not asset.textures:
        raise ValueError(f"{asset.path} has no texture, which variants need; leave out --variants")


def write_variants(asset: Asset, paintings: Iterable[tuple[str, Painting]], path: Path) -> None:
    """Write named paintings of an asset as one GLB with KHR_materials_variants, whole or not at all.

    A viewer that does not know the extension shows the first. Only encoded images are held. The variants that
    the file of the asset may have had are left out.
    """
    first, names, images = None, [], []
    for name, painting in paintings:
        first = painted_gltf(asset, painting) if first is None else first
        names.append(name)
        images.append(encoded(asset, "base_color", painting.images))
    assert first is not None
    used = sorted({part.material for part in asset.parts})
    places = enumerate(used) if not isinstance(asset.container, Gltf) else zip(used, used, strict=True)
    textures = {place: asset.paints[material].texture for place, material in places}
    shown = {place: texture for place, texture in textures.items() if texture in images[0]}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, glb.glb_bytes(with_variants(first, shown, names, images)))


def with_variants(
    gltf: Gltf, shown: Mapping[int, int], names: Sequence[str], images: Sequence[Mapping[int, bytes]]
) -> Gltf:
    """The same file with variants: in variant n, material m shows `images[n][shown[m]]`.

    The file's own materials are those of variant 0; each other variant has a copy of each.
    """
    document, views = json.loads(json.dumps(gltf.document)), list(gltf.views)
    material_of = {m: [m] for m in shown}
    for name, pngs in list(zip(names, images, strict=True))[1:]:
        new: dict[int, int] = {}
        for number, png in pngs.items():
            entry = {"name": name, "mimeType": "image/png", "bufferView": append_view(document, views, png)}
            new[number] = append(document, "images", entry)
        textures: dict[tuple[int, int], int] = {}  # by that of variant 0, which has the sampler, and image
        for m, number in shown.items():
            material = json.loads(json.dumps(document["materials"][m]))
            reference = texture_reference(material)
            key = reference["index"], number
            if key not in textures:
                entry = {**document["textures"][key[0]], "source": new[number]}
                textures[key] = append(document, "textures", entry)
            reference["index"] = textures[key]
            material["name"] = f"{material.get('name', f'material {m}')}, {name}"
            material_of[m].append(append(document, "materials", material))
    for mesh in document["meshes"]:
        for primitive in mesh["primitives"]:
            extensions = primitive.setdefault("extensions", {})
            extensions.pop(EXTENSION, None)
            if primitive.get("material") in material_of:
                rows = enumerate(material_of[primitive["material"]])
                extensions[EXTENSION] = {"mappings": [{"material": m, "variants": [n]} for n, m in rows]}
            if not extensions:
                del primitive["extensions"]
    document.setdefault("extensions", {})[EXTENSION] = {"variants": [{"name": name} for name in names]}
    document["extensionsUsed"] = sorted({*document.get("extensionsUsed", []), EXTENSION})
    return Gltf(document, tuple(views))
