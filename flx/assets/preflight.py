"""Checks, before the work starts, that the asset can be written, and lists what the new file will lack.

What it lacks is said in the words of the format that the asset comes from. Nothing is listed that keeps its
meaning: node transforms are applied, and opacity and smoothness are kept.
"""

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from flx.assets.asset import Asset, Format
from flx.assets.formats import glb, gltf, obj_source
from flx.assets.formats.gltf import Gltf
from flx.assets.formats.mtl import properties
from flx.assets.formats.obj_source import ObjSource
from flx.assets.formats.ply import ASCII
from flx.assets.write import atlas_files, check_room, other_files
from flx.files import check_place

MOST = 12  # names listed of one kind
APPLIED = {"KHR_texture_transform", "KHR_mesh_quantization", "EXT_texture_webp"}
WRITTEN = {"POSITION", "NORMAL", "TEXCOORD_0", "COLOR_0"}
USUAL = {"metallicFactor": 0, "roughnessFactor": 1}  # as an MTL without these is understood


def check_output(asset: Asset, format: Format, paths: Sequence[Path], beside: Sequence[Path] = ()) -> None:
    """Checks that the asset can be written to `paths`, with other files `beside` it. Lists on stderr, in one
    line, what the format cannot hold and which files are missing.

    Raises ValueError for a PLY (vertex colours only) of an asset with textures, where files of the asset
    would be overwritten, and where the folder cannot be made or written to.
    """
    for path in paths:
        check_place(path)
    if format == "ply" and asset.textures:
        raise ValueError(f"{asset.path} has textures, a PLY only vertex colours; use --format glb or obj")
    for path in paths:
        check_room(asset, path, [*beside, *atlas_files(asset, path).values()])
    notes = []
    if left := left_behind(asset, format):
        keeping = {ObjSource: "; --format obj keeps all", Gltf: "; --format glb keeps all"}
        notes.append(f"{left} stay behind{keeping.get(type(asset.container), '')}")
    if missing := dangling(asset, format):
        notes.append(f"missing, but named in the new file: {missing}")
    if notes:
        print(f"{asset.path}: {'; '.join(notes)}", file=sys.stderr)


def left_behind(asset: Asset, format: str) -> str:
    """What is lost when the asset is written in a format, in one line; "" for nothing."""
    source = asset.container
    if _is_kept(asset, format):
        return ""
    lost = _counted({"polygon": asset.report.polygons})
    if isinstance(source, Gltf):
        lost += _of_gltf(asset, source)
    elif isinstance(source, ObjSource):
        lost += _of_obj(asset, source, format)
    lost += _few(word for word in asset.report.unread if word != ASCII or format == "ply")
    if asset.textures and any(part.colors is not None for part in asset.parts):
        lost.append("vertex colours")
    if format == "ply":
        lost += ["materials"] * (source is not None)
        lost += ["texture coordinates"] * any(part.uvs is not None for part in asset.parts)
    return ", ".join(dict.fromkeys(lost))


def dangling(asset: Asset, format: str) -> str:
    """The missing files that the new file will name as the old one does."""
    source, names = asset.container, []
    if _is_kept(asset, format) and isinstance(source, ObjSource):
        names = [name for name in other_files(asset, source) if name not in source.maps]
    elif _is_kept(asset, format) and isinstance(source, Gltf):
        painted = {m for m, paint in enumerate(asset.paints) if _is_image(asset, paint.texture)}
        names = glb.missing_images(source, painted)
    return ", ".join(_few(names))


def _is_kept(asset: Asset, format: str) -> bool:
    """Whether the file is written as it was read, except for its colours."""
    kinds = {"glb": Gltf, "obj": ObjSource}
    return format in kinds and isinstance(asset.container, kinds[format])


def _is_image(asset: Asset, texture: int) -> bool:
    return texture >= 0 and not asset.textures[texture].flat


def _few(names: Iterable[str]) -> list[str]:
    """The first names of one kind, each on one line, and how many more there are."""
    words = list(dict.fromkeys(" ".join(name.split())[:80] for name in names))
    return [*words[:MOST], f"{len(words) - MOST:,} more"] if len(words) > MOST + 1 else words


def _counted(counts: Mapping[str, int]) -> list[str]:
    return [f"{count:,} {what}{'s' * (count > 1)}" for what, count in counts.items() if count]


def _of_obj(asset: Asset, source: ObjSource, format: str) -> list[str]:
    """Maps come first: they are missed most."""
    translucent = [p.texture for p in asset.paints if p.alpha_mode != "OPAQUE" and p.texture >= 0]
    kept = {asset.textures[texture].name for texture in translucent}
    lost = _few(name for name in other_files(asset, source) if name not in kept)
    tinted = any(_is_image(asset, p.texture) and p.color != (1.0, 1.0, 1.0) for p in asset.paints)
    keys = [key for library in source.libraries.values() for key in properties(library)]
    lost += _few(["Kd"] * tinted + keys)
    lost += _few(asset.report.ignored_options)
    counts = obj_source.structure(source)
    if format == "glb" and counts["object"] == 1:
        counts["object"] = 0  # its name becomes that of the mesh
    return lost + _counted(counts) + ["lines and points"] * obj_source.has_lines(source)


def _of_gltf(asset: Asset, source: Gltf) -> list[str]:
    document = source.document
    materials = document.get("materials", [])
    lost = _few(glb.other_images(source)) + _few(_material_words(materials))
    primitives = [p for mesh in document.get("meshes", []) for p in mesh.get("primitives", [])]
    attributes = {key: None for p in primitives for key in p.get("attributes", {}) if key not in WRITTEN}
    lost += _few(attributes)
    colors = [p["attributes"]["COLOR_0"] for p in primitives if "COLOR_0" in p.get("attributes", {})]
    if not asset.textures and any(document["accessors"][i].get("type") == "VEC4" for i in colors):
        lost.append("vertex alpha")
    lost += ["lines and points"] * any(p.get("mode", gltf.TRIANGLES) < gltf.TRIANGLES for p in primitives)
    lost += ["morph targets"] * any("targets" in p for p in primitives)
    lost += [key for key in ("animations", "skins", "cameras") if document.get(key)]
    lost += _few(e for e in document.get("extensionsUsed", []) if e not in APPLIED)
    lost += [f"{len(document['nodes']):,} nodes"] * (len(document.get("nodes", [])) > 1)
    lost += ["copyright"] * ("copyright" in document.get("asset", {}))
    lost += ["extras"] * ('"extras": ' in json.dumps(document))
    return lost


def _material_words(materials: list[dict]) -> list[str]:
    """The properties of materials other than the image or flat value of the base colour."""
    lost = []
    for material in materials:
        pbr = material.get("pbrMetallicRoughness", {})
        r, g, b, alpha = pbr.get("baseColorFactor", [1, 1, 1, 1])
        if alpha != 1 or (gltf.texture_reference(material) and (r, g, b) != (1, 1, 1)):
            lost.append("baseColorFactor")
        if material.get("alphaMode", "OPAQUE") != "OPAQUE":
            lost.append("alphaMode")
        lost += [key for key, usual in USUAL.items() if pbr.get(key, usual) != usual]
        lost += ["emissiveFactor"] * (material.get("emissiveFactor", [0, 0, 0]) != [0, 0, 0])
    return lost
