"""Makes an `Asset` of the contents of a file or of arrays: checks, repairs, decodes images.

`flx.geometry.repair` makes the mesh a manifold and counts its changes. The original rows stay in
`Asset.parts`: the file's own geometry is written, never the repaired one.

Texture coordinates run right and down. Base colours become 8-bit RGB, other maps keep 16 bits; alpha is kept
aside for the output. Factors that multiply a texture are ignored, and kept as they are.
"""

import hashlib
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int, UInt

from flx.arguments import counted
from flx.assets.asset import Asset, Report, Texture
from flx.assets.formats.files import BadFile, is_absolute, quoted, read_file
from flx.assets.formats.images import (
    check_together,
    decode_image,
    decode_map,
    is_turned,
    original_kind,
    split_alpha,
)
from flx.assets.formats.parts import Material, Paint, Part, stacked
from flx.assets.formats.readers import Contents, Picture
from flx.geometry.arrays import face_areas, mark
from flx.geometry.atlas import uv_areas
from flx.geometry.repair import Repaired, repair
from flx.types import Layer, Slot, TexturedMesh

FARTHEST = 1e30  # the largest coordinate: its cube is still finite
SMALLEST = 1e-20  # the smallest size of a mesh: areas of its faces can still be pictured
UNWRAP = "unwrap it in a 3D program such as Blender, or give its vertices colours"
MOST_TILES = 100.0  # how many times the surface may cover its textures


class Choice(NamedTuple):
    """The images of one slot, their textures, and the index of the image of each material in use."""

    images: list[UInt[Any, "_ _ 3"]]
    textures: list[Texture]
    image_of: dict[int, int]


def assemble(
    path: Path,
    contents: Contents,
    texture: Path | None = None,
    slots: Sequence[Slot] = ("base_color",),
    format: str = "",
) -> Asset:
    """Stacks the parts, repairs the mesh, colours its corners; `path` is the file, or the asset's name.

    Raises BadFile, ValueError or OSError; `faults_of` adds the path to their messages.
    """
    contents = contents._replace(parts=[part for part in contents.parts if len(part.faces)])
    parts = contents.parts
    _check(parts)
    choices = _choose_images(contents, texture, slots)
    points, part_faces = stacked(parts)
    faces = np.concatenate(part_faces)
    fixed = repair(points, faces)
    corners = faces[fixed.sources]
    materials = np.repeat([part.material for part in parts], [len(part.faces) for part in parts])
    colors = np.concatenate([_colors(part, contents.materials[part.material]) for part in parts])
    maps: dict[Slot, Layer] = {
        slot: _layer(contents, slot, choice, corners, materials[fixed.sources])
        for slot, choice in choices.items()
    }
    has_images = bool(choices["base_color"].images)
    corner_colors = np.zeros((len(corners), 3, 3), np.float32) if has_images else colors[corners]
    mesh = TexturedMesh(fixed.vertices, fixed.faces, maps, corner_colors)
    _check_measures(mesh)
    names: dict[Slot, dict[str, None]] = {}
    for material in contents.used:
        for slot, name in contents.materials[material].maps.items():
            names.setdefault(slot, {})[name] = None
    return Asset(
        path=path,
        mesh=mesh,
        report=_report(path, format, contents, mesh, choices["base_color"].textures, fixed),
        parts=tuple(parts),
        paints=tuple(_paint(m, index, choices) for index, m in enumerate(contents.materials)),
        sources={slot: tuple(choice.textures) for slot, choice in choices.items()},
        map_names={slot: tuple(of_slot) for slot, of_slot in names.items()},
        corner_vertices=corners,
        container=contents.container,
        digest=_digest(mesh),
    )


@contextmanager
def faults_of(path: Path) -> Iterator[None]:
    """Turns any fault of the asset into one ValueError that begins with the path."""
    try:
        yield
    except FileNotFoundError as fault:
        raise ValueError(f"{path}: {fault.filename} does not exist; put it there") from fault
    except OSError as fault:
        what = f"{str(fault.filename)[:80]} cannot be read ({fault.strerror})"
        raise ValueError(f"{path}: {what}; make it readable") from fault
    except ValueError as fault:
        raise ValueError(f"{path}: {fault}") from fault


def _check(parts: Sequence[Part]) -> None:
    """Raises ValueError for indices out of range, and for numbers that are not finite or too large."""
    if not parts:
        raise ValueError("no triangles; export the mesh with faces")
    for part in parts:
        if not 0 <= part.faces.min() <= part.faces.max() < len(part.positions):
            worst = part.faces.max() if part.faces.min() >= 0 else part.faces.min()
            names = f"names vertex {worst} of {len(part.positions)}"
            raise ValueError(f"a face of {part.name!r} {names}; export it again")
        _check_finite(part, part.positions, "vertex")
        _check_finite(part, part.uvs, "the texture coordinate of vertex")
        _check_finite(part, part.colors, "the colour of vertex")
    size = max(np.ptp(part.positions[mark(len(part.positions), part.faces)], axis=0).max() for part in parts)
    if 0 < size < SMALLEST:
        raise ValueError(f"no part is more than {size:.2g} across; scale the mesh up")


def _check_finite(part: Part, rows: Float64[Any, "V C"] | Float32[Any, "V C"] | None, what: str) -> None:
    if rows is None:
        return
    used = np.zeros(len(rows), bool)
    used[part.faces] = True
    wrong = used & ~(np.abs(rows) < FARTHEST).all(1)
    if wrong.any():
        row = int(wrong.argmax())
        value = f"{what} {row} of {part.name!r} is {rows[row].tolist()}: not finite, or too far"
        raise ValueError(f"{value}; export it again")


# ---------------------------------------------------------------------------------------------- images


def _choose_images(contents: Contents, override: Path | None, slots: Sequence[Slot]) -> dict[Slot, Choice]:
    """The images of base colours and of these slots; their total size is checked before any is decoded."""
    wanted: dict[Slot, dict[int, str]] = {"base_color": _wanted_colors(contents, override)}
    wanted |= {slot: _wanted_maps(contents, slot) for slot in slots if slot != "base_color"}
    for part in contents.parts:
        for slot, names in wanted.items():
            if part.material in names and contents.slot_uvs(part, slot) is None:
                what = "a texture" if slot == "base_color" else f"a {slot} map"
                raise ValueError(f"{part.name!r} has {what} but no texture coordinates; {UNWRAP}")
    base = list(dict.fromkeys(wanted["base_color"].values()))
    encoded: dict[str, bytes | Picture] = {}
    for name in dict.fromkeys(name for names in wanted.values() for name in names.values()):
        if override is not None and name in base:
            encoded[name] = read_file(override)
        else:
            encoded[name] = _encoded(contents, name, base == [name])
    check_together({name: content for name, content in encoded.items() if isinstance(content, bytes)})
    return {slot: _decoded(contents, encoded, slot, names) for slot, names in wanted.items()}


def _wanted_colors(contents: Contents, override: Path | None) -> dict[int, str]:
    """The base colour image of each material that has one; empty for vertex colours."""
    wanted = {m: name for m in contents.used if (name := contents.materials[m].image) is not None}
    if override is None:
        return wanted
    if (count := len(set(wanted.values()))) > 1:
        raise ValueError(f"{count} base colour images, --texture replaces one; edit the materials")
    return dict.fromkeys(wanted or contents.used, str(override))


def _wanted_maps(contents: Contents, slot: Slot) -> dict[int, str]:
    """The image in another slot of each material that has one. Raises ValueError where none has."""
    wanted = {m: name for m in contents.used if (name := contents.materials[m].maps.get(slot))}
    if not wanted:
        slots = {name for m in contents.used for name in contents.materials[m].maps}
        others = ", ".join(sorted(slots)) or "none"
        raise ValueError(f"there is no {slot} map (other maps: {others}); leave it out of slots")
    return wanted


def _decoded(
    contents: Contents, encoded: dict[str, bytes | Picture], slot: Slot, wanted: dict[int, str]
) -> Choice:
    """The decoded images, and a small one for each material that has a flat value instead."""
    if not wanted and any(part.colors is not None for part in contents.parts):
        return Choice([], [], {})
    if not wanted:
        if any(part.uvs is None for part in contents.parts):
            raise ValueError(f"no texture, no vertex colours and no texture coordinates; {UNWRAP}")
        here = f"--texture {contents.beside}, which lies here" if contents.beside else "--texture IMAGE"
        raise ValueError(f"no texture and no vertex colours ({contents.hint}); pass {here}")
    names, images, textures = list(dict.fromkeys(wanted.values())), [], []
    for name in names:
        content, kind, turned = encoded[name], "", False
        if not isinstance(content, bytes):
            image, alpha = split_alpha(content)
        elif slot == "base_color":
            (image, alpha), kind = decode_image(content, name), original_kind(content, name)
            turned = is_turned(content, name)
        else:
            image, alpha = decode_map(content, name)
        images.append(image)
        textures.append(Texture(name, alpha, flat=False, made_from=kind, turned=turned))
    image_of = {m: names.index(name) for m, name in wanted.items()}
    for material in (m for m in contents.used if m not in wanted):
        image_of[material] = len(images)
        value = np.nan_to_num(contents.materials[material].flat_value(slot)).clip(0, 1)
        images.append(np.tile(np.rint(255 * value).astype(np.uint8), (4, 4, 1)))
        textures.append(Texture(contents.materials[material].name, None, flat=True))
    return Choice(images, textures, image_of)


def _encoded(contents: Contents, name: str, replaceable: bool) -> bytes | Picture:
    """The image's file. The error suggests --texture only for a `replaceable` image, a single base colour."""
    try:
        return contents.load_image(name)
    except FileNotFoundError as fault:
        named = str(fault.filename)
        where = "next to the mesh" if is_absolute(named) or not re.search(r"[/\\]", named) else "there"
        other = ", or pass --texture" if replaceable else ""
        raise BadFile(f"{quoted(named)} does not exist; put it {where}{other}") from fault


# ---------------------------------------------------------------------------------------------- the mesh


def _layer(
    contents: Contents, slot: Slot, choice: Choice, corners: Int[Any, "F 3"], materials: Int[Any, "F"]
) -> Layer:
    """The images of a slot, and where the corners of repaired faces read them."""
    image_of = np.array([choice.image_of.get(m, 0) for m in range(len(contents.materials))])
    rows = []
    for part in contents.parts:
        uvs = contents.slot_uvs(part, slot) if choice.images else None
        _check_finite(part, uvs, f"the {slot} coordinate of vertex")
        rows.append(np.zeros((len(part.positions), 2)) if uvs is None else uvs)
    return Layer(tuple(choice.images), image_of[materials], np.concatenate(rows)[corners])


def _colors(part: Part, material: Material) -> Any:
    if part.colors is not None:
        return part.colors
    return np.tile(np.array(material.color, np.float32), (len(part.positions), 1))


def _paint(material: Material, index: int, choices: dict[Slot, Choice]) -> Paint:
    """How a material looks. Alpha counts only where the material says so: an image may hold stray alpha."""
    images: dict[Slot, int] = {
        slot: choice.image_of[index] for slot, choice in choices.items() if index in choice.image_of
    }
    base = choices["base_color"].textures[images["base_color"]] if "base_color" in images else None
    alpha = base.alpha if base and material.opacity_image == base.name else None
    mode = "OPAQUE" if alpha is None else "MASK" if np.isin(alpha, (0, 255)).all() else "BLEND"
    mode = "BLEND" if material.opacity < 1 else mode
    return Paint(material.name, images, material.color, material.opacity, mode)


def _check_measures(mesh: TexturedMesh) -> None:
    """Raises ValueError for a surface without area, and for one that repeats its textures too often."""
    if not face_areas(mesh.vertices, mesh.faces).max() > 0:
        raise ValueError("every face has zero area; export it again, or scale it up")
    tiles = max(np.abs(uv_areas(mesh, slot)).sum() for slot in mesh.maps)
    if tiles > MOST_TILES:
        times = f"{counted(tiles)} times, more than {MOST_TILES:.0f}"
        raise ValueError(f"the surface covers its textures {times}; unwrap it anew")


def _digest(mesh: TexturedMesh) -> str:
    """A digest of the mesh, on which prepared tables and runs depend, independent of the file's place."""
    digest = hashlib.sha256()

    def add(*arrays: np.ndarray) -> None:
        for array in arrays:
            digest.update(f"{array.dtype}{array.shape}".encode() + np.ascontiguousarray(array).tobytes())

    add(mesh.vertices, mesh.faces, mesh.corner_uvs, mesh.face_textures, *mesh.textures, mesh.corner_colors)
    for slot in sorted(mesh.maps.keys() - {"base_color"}):
        digest.update(slot.encode())
        add(mesh.maps[slot].corner_uvs, mesh.maps[slot].face_images, *mesh.maps[slot].images)
    return digest.hexdigest()


def _report(
    path: Path, format: str, contents: Contents, mesh: TexturedMesh, textures: list[Texture], fixed: Repaired
) -> Report:
    outside = ((mesh.corner_uvs < 0) | (mesh.corner_uvs > 1)).any((1, 2))
    painted = ~np.array([t.flat for t in textures] or [True])[mesh.face_textures]
    parts = contents.parts
    return Report(
        path=str(path),
        format=format or path.suffix[1:].upper(),
        parts=len(parts),
        materials=len(contents.used),
        vertices_read=sum(len(part.positions) for part in parts),
        faces_read=sum(len(part.faces) for part in parts),
        polygons=contents.polygons,
        **fixed.repairs._asdict(),
        vertices=len(mesh.vertices),
        faces=len(mesh.faces),
        **fixed.topology._asdict(),
        flat_uv_faces=int((painted & (np.abs(uv_areas(mesh)) <= 1e-14)).sum()),
        outside_uv_faces=int((painted & outside).sum()),
        color_source="texture" if textures else "vertex colours",
        textures=tuple(map(_in_words, textures, mesh.textures)),
        missing_images=contents.missing_images,
        ignored_options=contents.ignored_options,
        found_images=contents.found_images,
        unread=contents.unread,
    )


def _in_words(texture: Texture, image: UInt[Any, "H W 3"]) -> str:
    was = " (flat)" if texture.flat else f", made from {texture.made_from}" * bool(texture.made_from)
    return f"{texture.name}: {image.shape[1]} × {image.shape[0]}{was}{', EXIF turns it' * texture.turned}"
