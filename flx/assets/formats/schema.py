"""Checks a glTF document before any of it is used: the types of values, and that indices are in range.

Only what this project reads or writes is checked; extras and unknown extensions are not.
"""

import math
from collections.abc import Callable
from typing import Any

from flx.assets.formats.files import BadFile

# What a value must be: {key: rule} for an object, [rule] for a list, n for n numbers, or a function of it and
# of the document, which returns "" or, in words, what it wanted.
Rule = dict[str, Any] | list[Any] | int | Callable[[Any, dict], str]
EACH = "each"  # as the only key of an object's rule: the rule of all its values


def check_document(document: Any) -> None:
    """Raises BadFile for a document that is not glTF 2.0, is inconsistent, or requires unknown extensions."""
    if not isinstance(document, dict):
        raise BadFile("its JSON is not an object; export it again as glTF 2.0")
    _check(document, GLTF, "", document)
    for index, material in enumerate(document.get("materials", [])):
        _check_textures(material, f"materials[{index}]", document)
    version = document.get("asset", {}).get("version", "2.0")
    if not version.startswith("2."):
        raise BadFile(f"glTF version {version[:20]!r}; export it again as glTF 2.0")
    if compressed := COMPRESSED & set(document.get("extensionsUsed", [])):
        raise BadFile(f"its geometry is compressed ({min(compressed)}); save it without compression")
    unknown = set(document.get("extensionsRequired", [])) - KNOWN
    if unknown := {name for name in unknown if not name.startswith("KHR_materials_")}:  # only about lighting
        raise BadFile(f"it requires the extension {min(unknown)[:60]!r}; export it without")
    _check_tree(document.get("nodes", []))


COMPRESSED = {
    *("KHR_draco_mesh_compression", "EXT_meshopt_compression"),
    *("KHR_meshopt_compression", "MESHOPT_compression"),
}
KNOWN = {
    *("KHR_texture_transform", "KHR_mesh_quantization", "EXT_texture_webp", "KHR_texture_basisu"),
    *("MSFT_texture_dds", "EXT_texture_avif", "KHR_lights_punctual", "KHR_xmp_json_ld"),
}  # an image that cannot be decoded is refused only if a base colour uses it


def _check(value: Any, rule: Rule, place: str, document: dict) -> None:
    """Raises BadFile for a value that breaks its rule, naming its place. Objects may lack any key."""
    if isinstance(rule, dict):
        _check(value, _object, place, document)
        rules: dict[str, Any] = dict.fromkeys(value, rule[EACH]) if EACH in rule else rule
        for key, inner in rules.items():
            if key in value:
                _check(value[key], inner, f"{place}.{key[:40]}".lstrip("."), document)
    elif isinstance(rule, list):
        _check(value, _list, place, document)
        for index, child in enumerate(value):
            _check(child, rule[0], f"{place}[{index}]", document)
    elif isinstance(rule, int):
        as_many = isinstance(value, list) and len(value) == rule
        if as_many and all(map(_is_number, value)):
            return  # at once: there may be very many
        _check(value, [_number] if as_many else _must(lambda _: False, f"{rule} numbers"), place, document)
    elif wanted := rule(value, document):
        found = f"{place or 'the document'} is {repr(value)[:40]}"
        raise BadFile(f"{found}, not {wanted}; export the file again")


def _check_textures(value: dict, place: str, document: dict) -> None:
    """Every texture reference of a material, including those in extensions that are not known here."""
    for key, child in value.items():
        if key.endswith("Texture"):
            _check(child, TEXTURE, f"{place}.{key[:40]}", document)
        elif isinstance(child, dict) and key != "extras":
            _check_textures(child, f"{place}.{key[:40]}", document)


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)


def _must(holds: Callable[[Any], bool], wanted: str) -> Callable[[Any, dict], str]:
    """The rule that a condition holds for the value; `wanted` says it in words."""
    return lambda value, _: "" if holds(value) else wanted


def _one_of(*allowed: Any) -> Callable[[Any, dict], str]:
    wanted = f"one of {', '.join(map(str, allowed))}"
    return _must(lambda value: type(value) in (int, str) and value in allowed, wanted)


def _index(key: str) -> Callable[[Any, dict], str]:
    """The rule that a value is an index into one of the document's lists."""

    def fault(value: Any, document: dict) -> str:
        known = document.get(key, [])
        count = len(known) if isinstance(known, list) else 0
        return "" if type(value) is int and 0 <= value < count else f"one of {count} {key}"

    return fault


_object = _must(lambda value: isinstance(value, dict), "an object")
_list = _must(lambda value: isinstance(value, list), "a list")
_text = _must(lambda value: isinstance(value, str), "a text")
_whole = _must(lambda value: type(value) is int and 0 <= value < 1 << 53, "a whole number")
_number = _must(_is_number, "a number")

PLACED = {"offset": 2, "scale": 2, "rotation": _number, "texCoord": _whole}
EXTENSIONS = {"KHR_texture_transform": PLACED}
TEXTURE = {"index": _index("textures"), "texCoord": _whole, "extensions": EXTENSIONS}
VIEW = {"bufferView": _index("bufferViews"), "byteOffset": _whole}
TRANSFORM = {"matrix": 16, "rotation": 4, "scale": 3, "translation": 3}
PRIMITIVE = {
    "attributes": {EACH: _index("accessors")},
    "indices": _index("accessors"),
    "material": _index("materials"),
    "mode": _one_of(*range(7)),
}
ACCESSOR = {
    **VIEW,
    "count": _whole,
    "componentType": _one_of(5120, 5121, 5122, 5123, 5125, 5126),
    "type": _one_of("SCALAR", "VEC2", "VEC3", "VEC4", "MAT2", "MAT3", "MAT4"),
    "sparse": {
        "count": _whole,
        "indices": {**VIEW, "componentType": _one_of(5121, 5123, 5125)},
        "values": VIEW,
    },
}
SPAN = dict.fromkeys(("byteOffset", "byteLength", "byteStride"), _whole)
PBR = {"baseColorFactor": 4}
SOURCE = {"source": _index("images")}
GLTF: Rule = {
    "asset": {"version": _text},
    "extensionsUsed": [_text],
    "extensionsRequired": [_text],
    "scene": _index("scenes"),
    "scenes": [{"nodes": [_index("nodes")]}],
    "nodes": [{"mesh": _index("meshes"), "children": [_index("nodes")], **TRANSFORM}],
    "meshes": [{"name": _text, "primitives": [PRIMITIVE]}],
    "materials": [{"name": _text, "pbrMetallicRoughness": PBR, "extensions": {EACH: _object}}],
    "textures": [{**SOURCE, "extensions": {EACH: SOURCE}}],
    "images": [{"name": _text, "uri": _text, "mimeType": _text, "bufferView": _index("bufferViews")}],
    "accessors": [ACCESSOR],
    "bufferViews": [{"buffer": _index("buffers"), **SPAN}],
    "buffers": [{"uri": _text, "byteLength": _whole}],
}


def _check_tree(nodes: list[dict]) -> None:
    """Nodes form trees (glTF 2.0, section 3.5.2): none has two parents, and none is its own ancestor."""
    parent: dict[int, int] = {}
    for index, node in enumerate(nodes):
        for child in node.get("children", []):
            if child in parent:
                parents = f"{parent[child]} and {index}"
                raise BadFile(f"node {child} is a child twice, of {parents}; export it again")
            parent[child] = index
    checked: set[int] = set()
    for start in parent:
        node, path = start, set()
        while node in parent and node not in checked:
            if node in path:
                raise BadFile(f"node {node} is its own ancestor; export it again")
            path.add(node)
            node = parent[node]
        checked |= path
