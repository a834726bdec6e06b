"""Checks a glTF document before any of it is used: the types of values, and that indices are in range.

Only what this project reads or writes is checked; extras and unknown extensions are not. A rule is a function
of a value, its place in words, and the document; it raises BadFile or returns nothing.
"""

import math
from collections.abc import Callable
from typing import Any

from flx.assets.formats.files import BadFile

Rule = Callable[[Any, str, dict], None]


def check_document(document: Any) -> None:
    """Raises BadFile for a document that is not glTF 2.0, is inconsistent, or requires unknown extensions."""
    if not isinstance(document, dict):
        raise BadFile("its JSON is not an object; export it again as glTF 2.0")
    _GLTF(document, "", document)
    version = document.get("asset", {}).get("version", "2.0")
    if not version.startswith("2."):
        raise BadFile(f"glTF version {version[:20]!r}; export it again as glTF 2.0")
    if compressed := COMPRESSED & set(document.get("extensionsUsed", [])):
        raise BadFile(f"its geometry is compressed ({min(compressed)}); save it without compression")
    unknown = set(document.get("extensionsRequired", [])) - KNOWN
    if unknown := {name for name in unknown if not name.startswith("KHR_materials_")}:  # only about lighting
        raise BadFile(f"it requires the extension {min(unknown)[:60]!r}; export it without")
    _check_tree(document)


COMPRESSED = {
    *("KHR_draco_mesh_compression", "EXT_meshopt_compression"),
    *("KHR_meshopt_compression", "MESHOPT_compression"),
}
KNOWN = {
    *("KHR_texture_transform", "KHR_mesh_quantization", "EXT_texture_webp", "KHR_texture_basisu"),
    *("MSFT_texture_dds", "EXT_texture_avif", "KHR_lights_punctual", "KHR_xmp_json_ld"),
}  # an image that cannot be decoded is refused only if a base colour uses it


def _fail(place: str, value: Any, wanted: str) -> BadFile:
    return BadFile(f"{place or 'the document'} is {repr(value)[:40]}, not {wanted}; export the file again")


def _must(holds: Callable[[Any], bool], wanted: str) -> Rule:
    """The rule that a condition holds for the value; `wanted` says it in words."""

    def rule(value: Any, place: str, document: dict) -> None:
        if not holds(value):
            raise _fail(place, value, wanted)

    return rule


def _one_of(*allowed: Any) -> Rule:
    wanted = f"one of {', '.join(map(str, allowed))}"
    return _must(lambda value: type(value) in (int, str) and value in allowed, wanted)


_object = _must(lambda value: isinstance(value, dict), "an object")
_list = _must(lambda value: isinstance(value, list), "a list")
_text = _must(lambda value: isinstance(value, str), "a text")
_whole = _must(lambda value: type(value) is int and 0 <= value < 1 << 53, "a whole number")
_number = _must(lambda value: type(value) in (int, float) and math.isfinite(value), "a number")


def _record(**rules: Rule) -> Rule:
    def rule(value: Any, place: str, document: dict) -> None:
        _object(value, place, document)
        for key, inner in rules.items():
            if key in value:
                inner(value[key], f"{place}.{key}".lstrip("."), document)

    return rule


def _values(inner: Rule) -> Rule:
    def rule(value: Any, place: str, document: dict) -> None:
        _object(value, place, document)
        for key, child in value.items():
            inner(child, f"{place}.{key[:40]}", document)

    return rule


def _many(inner: Rule) -> Rule:
    def rule(value: Any, place: str, document: dict) -> None:
        _list(value, place, document)
        for index, child in enumerate(value):
            inner(child, f"{place}[{index}]", document)

    return rule


def _index(key: str) -> Rule:
    def rule(value: Any, place: str, document: dict) -> None:
        known = document.get(key, [])
        count = len(known) if isinstance(known, list) else 0
        if type(value) is not int or not 0 <= value < count:
            raise _fail(place, value, f"one of {count} {key}")

    return rule


def _vector(length: int) -> Rule:
    def rule(value: Any, place: str, document: dict) -> None:
        if not isinstance(value, list) or len(value) != length:
            raise _fail(place, value, f"{length} numbers")
        for child in value:
            _number(child, place, document)

    return rule


_SLOT = _record(
    index=_index("textures"),
    texCoord=_whole,
    extensions=_record(
        KHR_texture_transform=_record(offset=_vector(2), scale=_vector(2), rotation=_number, texCoord=_whole)
    ),
)


def _slots(value: Any, place: str, document: dict) -> None:
    """Every texture reference of a material, including those in extensions that are not known here."""
    _object(value, place, document)
    for key, child in value.items():
        if key.endswith("Texture"):
            _SLOT(child, f"{place}.{key[:40]}", document)
        elif isinstance(child, dict) and key != "extras":
            _slots(child, f"{place}.{key[:40]}", document)


_MATERIAL = _record(
    name=_text, pbrMetallicRoughness=_record(baseColorFactor=_vector(4)), extensions=_values(_object)
)


def _material(value: Any, place: str, document: dict) -> None:
    _slots(value, place, document)
    _MATERIAL(value, place, document)


_VIEW = _index("bufferViews")
_SOURCE = _record(source=_index("images"))
_GLTF = _record(
    asset=_record(version=_text),
    extensionsUsed=_many(_text),
    extensionsRequired=_many(_text),
    scene=_index("scenes"),
    scenes=_many(_record(nodes=_many(_index("nodes")))),
    nodes=_many(
        _record(
            mesh=_index("meshes"),
            children=_many(_index("nodes")),
            matrix=_vector(16),
            rotation=_vector(4),
            scale=_vector(3),
            translation=_vector(3),
        )
    ),
    meshes=_many(
        _record(
            name=_text,
            primitives=_many(
                _record(
                    attributes=_values(_index("accessors")),
                    indices=_index("accessors"),
                    material=_index("materials"),
                    mode=_one_of(*range(7)),
                )
            ),
        )
    ),
    materials=_many(_material),
    textures=_many(_record(source=_index("images"), extensions=_values(_SOURCE))),
    images=_many(_record(name=_text, uri=_text, mimeType=_text, bufferView=_VIEW)),
    accessors=_many(
        _record(
            bufferView=_VIEW,
            byteOffset=_whole,
            count=_whole,
            componentType=_one_of(5120, 5121, 5122, 5123, 5125, 5126),
            type=_one_of("SCALAR", "VEC2", "VEC3", "VEC4", "MAT2", "MAT3", "MAT4"),
            sparse=_record(
                count=_whole,
                indices=_record(bufferView=_VIEW, byteOffset=_whole, componentType=_one_of(5121, 5123, 5125)),
                values=_record(bufferView=_VIEW, byteOffset=_whole),
            ),
        )
    ),
    bufferViews=_many(
        _record(buffer=_index("buffers"), byteOffset=_whole, byteLength=_whole, byteStride=_whole)
    ),
    buffers=_many(_record(uri=_text, byteLength=_whole)),
)


def _check_tree(document: dict) -> None:
    """Nodes form trees (glTF 2.0, section 3.5.2): none has two parents, and none is its own ancestor."""
    nodes = document.get("nodes", [])
    parent: dict[int, int] = {}
    for index, node in enumerate(nodes):
        for child in node.get("children", []):
            if child in parent:
                raise BadFile(
                    f"node {child} is a child twice, of {parent[child]} and {index}; export it again"
                )
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
