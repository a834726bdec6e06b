"""The file formats: each reader turns a file into `Contents`, and judges nothing.

GLB and glTF are read by `flx.mesh.gltf`; OBJ and PLY by trimesh, of whose silences none is kept: it is given
text and bytes, never a folder; material files are read here, images are decoded by the caller; face indices
that it would wrap around are refused. (Its `maintain_order` is not used: it averages the texture coordinates
of a seam.) Texture coordinates run right and down in what is returned, whatever the format.
"""

import io
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from trimesh.exchange.obj import load_obj
from trimesh.exchange.ply import load_ply

from flx.mesh import gltf
from flx.mesh.gltf import BadFile, Gltf, Part


class Material(NamedTuple):
    """A material as a file states it; `image` is what the file calls its base colour image."""

    name: str
    color: tuple[float, float, float]  # sRGB
    image: str | None


class Contents(NamedTuple):
    """A file, read but not yet judged."""

    parts: list[Part]
    materials: list[Material]
    load_image: Callable[[str], bytes]
    hint: str  # where a texture was looked for
    container: Gltf | None
    missing_images: tuple[str, ...]


def _read_gltf(path: Path) -> Contents:
    container = gltf.read_gltf(path)
    document, images = container.document, container.document.get("images", [])
    materials = []
    for index, entry in enumerate(document.get("materials", [])):
        texture = gltf.base_slot(entry).get("index")
        image = None if texture is None else gltf.texture_image(document, texture)
        if image is not None and image < 0:
            raise BadFile(f"the texture of material {index} is in no known format; save it as PNG or JPEG")
        name = (
            None
            if image is None
            else f"{images[image].get('name', images[image].get('uri', 'image'))} #{image}"
        )
        materials.append(Material(entry.get("name", f"material {index}"), gltf.base_color(entry), name))
    materials.append(Material("default", (1.0, 1.0, 1.0), None))
    return Contents(
        parts=gltf.parts(container),
        materials=materials,
        load_image=lambda name: gltf.image_bytes(container, int(name.rpartition("#")[2])),
        hint="no material has a base colour texture",
        container=container,
        missing_images=tuple(image["uri"] for image in images if "bufferView" not in image),
    )


def _read_obj(path: Path) -> Contents:
    """Materials by our own eyes; trimesh is given a list of their names in place of the file."""
    text = path.read_bytes().decode("utf-8", errors="replace").replace("\r\n", "\n")
    _check_obj_indices(text)
    libraries = re.findall(r"^mtllib[ \t]+(.+?)[ \t]*$", text, re.MULTILINE)
    defined, hint = _read_mtl(path.parent, libraries)
    names = list(
        dict.fromkeys(name.strip() for name in re.findall(r"^usemtl[ \t]+(.+)$", text, re.MULTILINE))
    )
    listing = "\n".join(f"newmtl {name}" for name in names).encode()
    text = "mtllib names.mtl\n" + re.sub(r"^mtllib.*$", "", text, flags=re.MULTILINE)
    found = load_obj(io.StringIO(text), resolver={"names.mtl": listing})  # type: ignore

    white = Material(path.stem, (1.0, 1.0, 1.0), None)
    materials = [defined.get(name, white._replace(name=name)) for name in names] + [white]
    parts = []
    for geometry in reversed(found.get("geometry", {}).values()):
        visual = geometry.get("visual")
        name = getattr(getattr(visual, "material", None), "name", None)
        number = names.index(name) if name in names else len(names)
        parts.append(_part(materials[number].name, number, geometry, getattr(visual, "uv", None)))
    return Contents(
        parts=parts,
        materials=materials,
        load_image=lambda name: gltf.inside(path.parent, name).read_bytes(),
        hint=hint,
        container=None,
        missing_images=(),
    )


def _check_obj_indices(text: str) -> None:
    """trimesh wraps index 0 to the last vertex and counts relative indices from the end of the file."""
    if zero := re.search(r"^f[ \t].*?(?<![\w.-])0+(?=[/\s])", text + "\n", re.MULTILINE):
        raise BadFile(f"face {zero.group()!r} has index 0, but OBJ counts from 1; export it again")
    relative = re.search(r"^f[ \t]+(?:.*[ \t/])?-\d", text, re.MULTILINE)
    if relative and re.search(r"^v[tn]?[ \t]", text[relative.end() :], re.MULTILINE):
        raise BadFile("relative face indices between vertices; export it with absolute indices")


def _read_mtl(folder: Path, libraries: Sequence[str]) -> tuple[dict[str, Material], str]:
    """Materials by name, and in words where a texture was expected."""
    materials: dict[str, Material] = {}
    hint = "no material file, mtllib, is named" if not libraries else "no map_Kd in " + ", ".join(libraries)
    for library in libraries:
        try:
            text = gltf.inside(folder, library).read_text(errors="replace")
        except OSError:
            hint = f"{folder / library} does not exist"
            continue
        name = ""
        for key, *values in (line.split() for line in text.splitlines() if line.strip()):
            if key.lower() == "newmtl":
                name = " ".join(values)
                materials[name] = Material(name, (1.0, 1.0, 1.0), None)
            elif key.lower() == "kd" and name and len(values) >= 3:
                r, g, b = (min(max(float(value), 0.0), 1.0) for value in values[:3])
                materials[name] = materials[name]._replace(color=(r, g, b))
            elif key.lower() == "map_kd" and name and values:
                # Options (-s 1 1 1) come first; a name may hold spaces.
                image = values[-1] if values[0].startswith("-") else " ".join(values)
                materials[name] = materials[name]._replace(image=image)
    return materials, hint


def _read_ply(path: Path) -> Contents:
    content = path.read_bytes()
    header = content[: content.find(b"end_header") + 1]
    comment = re.search(
        rb"^comment[ \t]+TextureFile[ \t]+(.+?)[ \t\r]*$", header, re.MULTILINE | re.IGNORECASE
    )
    image = comment.group(1).decode(errors="replace") if comment else None
    found = load_ply(io.BytesIO(content), skip_materials=True)
    colored = found.get("vertex_colors") is not None and image is None
    if colored:  # one row for each colour: not split at the seams of a texture that is not there
        found = load_ply(io.BytesIO(content), skip_materials=True, fix_texture=False)
    parts = []
    if found.get("faces") is not None:
        parts = [_part(path.stem, 0, found, getattr(found.get("visual"), "uv", None))]
    return Contents(
        parts=parts,
        materials=[Material(path.stem, (1.0, 1.0, 1.0), image)],
        load_image=lambda name: gltf.inside(path.parent, name).read_bytes(),
        hint="no comment TextureFile",
        container=None,
        missing_images=(),
    )


def _part(name: str, material: int, geometry: dict, uvs: Any) -> Part:
    """A part from trimesh's arrays, whose texture coordinates run up."""
    positions = np.asarray(geometry["vertices"], np.float64)
    normals, colors = geometry.get("vertex_normals"), geometry.get("vertex_colors")
    if colors is not None:
        colors = np.asarray(colors)[:, :3]
        colors = (colors / (np.iinfo(colors.dtype).max if colors.dtype.kind in "iu" else 1)).astype(
            np.float32
        )
    return Part(
        name=name,
        material=material,
        positions=positions,
        normals=None
        if normals is None or len(normals) != len(positions)
        else np.asarray(normals, np.float64),
        uvs=None if uvs is None else np.asarray(uvs, np.float64) * [1, -1] + [0, 1],
        colors=None if colors is None or len(colors) != len(positions) else colors.clip(0, 1),
        faces=np.asarray(geometry["faces"], np.int64).reshape(-1, 3),
    )


READERS = {".obj": _read_obj, ".glb": _read_gltf, ".gltf": _read_gltf, ".ply": _read_ply}
