"""The door: a textured mesh file in, a validated `TexturedMesh` and a report out; and the same file back with
new colours.

`flx.assets.formats` reads the file, `flx.geometry.repair` makes a manifold of it and counts what it does,
`formats.glb` and `flx.assets.write` write. Original rows are kept in `Asset.parts`: what is written is the
file's own geometry, never the repaired one.

Texture coordinates run right and down. Images become 8-bit RGB; alpha is kept aside for the output. Factors
that multiply a texture are ignored, and left as they are.
"""

import hashlib
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from flx.assets.asset import Asset, Report, Texture
from flx.assets.formats.files import BadFile, is_absolute, quoted, read_file
from flx.assets.formats.images import check_together, decode_image, told_of
from flx.assets.formats.parts import Material, Paint, Part
from flx.assets.formats.readers import READERS, Contents
from flx.geometry.atlas import uv_areas
from flx.geometry.repair import Repaired, repair
from flx.types import TexturedMesh

FARTHEST = 1e30  # coordinates whose cubes are still numbers
MOST_TILES = 100.0  # textures that the surface may cover, its repetitions counted


# ---------------------------------------------------------------------------------------------- reading


def read_asset(path: str | Path, texture: str | Path | None = None) -> Asset:
    """Reads, repairs and reports. `texture` takes the place of the file's one base colour image, or of none.

    Raises FileNotFoundError, or ValueError where the file has no triangles, no colour, an unreadable part or
    more than one image for `texture` to replace.
    """
    path = Path(path)
    reader = READERS.get(path.suffix.lower())
    try:
        if not path.exists():
            raise FileNotFoundError(f"{path} does not exist; name a mesh file ({', '.join(READERS)})")
        if reader is None or not path.is_file():
            raise ValueError(f"{path} is not a mesh file; give one of {', '.join(READERS)}")
        if path.stat().st_size == 0:
            raise ValueError(f"{path} is empty; export it again")
    except OSError as fault:
        if isinstance(fault, FileNotFoundError):
            raise
        raise ValueError(f"{str(path)[:80]} cannot be opened ({fault.strerror}); give a mesh file") from fault
    try:
        contents = _read_contents(path, reader)
        _check(contents)
        images, textures, texture_of = _choose_textures(contents, None if texture is None else Path(texture))
        return _assemble(path, contents, images, textures, texture_of)
    except FileNotFoundError as fault:
        raise ValueError(f"{path}: {fault.filename} does not exist; put it there") from fault
    except OSError as fault:
        raise ValueError(
            f"{path}: {str(fault.filename)[:80]} cannot be read ({fault.strerror}); make it readable"
        ) from fault
    except ValueError as fault:
        raise ValueError(f"{path}: {fault}") from fault


def _read_contents(path: Path, reader: Callable[[Path], Contents]) -> Contents:
    """Whatever a parser stumbles over, in one line."""
    try:
        return reader(path)
    except (BadFile, OSError):
        raise
    except Exception as fault:
        what = " ".join(f"{type(fault).__name__}: {fault}".split())[:200]
        raise ValueError(f"cannot be read ({what}); export it again") from fault


def _check(contents: Contents) -> None:
    """What nothing later looks at: indices in range, and numbers that one can reckon with."""
    if not sum(len(part.faces) for part in contents.parts):
        raise ValueError("no triangles; export the mesh with faces")
    for part in contents.parts:
        if len(part.faces) and not 0 <= part.faces.min() <= part.faces.max() < len(part.positions):
            worst = part.faces.max() if part.faces.min() >= 0 else part.faces.min()
            raise ValueError(
                f"a face of {part.name!r} names vertex {worst} of {len(part.positions)}; export it again"
            )
        used = np.zeros(len(part.positions), bool)
        used[part.faces] = True
        for values, most, what in (
            (part.positions, FARTHEST, "vertex"),
            (part.uvs, FARTHEST, "the texture coordinate of vertex"),
            (part.colors, FARTHEST, "the colour of vertex"),
        ):
            if values is None:
                continue
            wrong = used & ~(np.abs(values) < most).all(1)
            if wrong.any():
                row = int(wrong.argmax())
                told = f"{what} {row} of {part.name!r} is {values[row].tolist()}: not finite, or too far"
                raise ValueError(f"{told}; export it again")


def _choose_textures(
    contents: Contents, override: Path | None
) -> tuple[list[UInt8[Any, "_ _ 3"]], list[Texture], dict[int, int]]:
    """Images, what goes with them, and the image of each material in use. No images: vertex colours."""
    used = sorted({part.material for part in contents.parts if len(part.faces)})
    wanted = {m: name for m in used if (name := contents.materials[m].image) is not None}
    names = list(dict.fromkeys(wanted.values()))
    if override is not None:
        if len(names) > 1:
            raise ValueError(f"{len(names)} base colour images, --texture replaces one; edit the materials")
        names, wanted = [str(override)], dict.fromkeys(wanted or used, str(override))
    elif not names and any(part.colors is not None for part in contents.parts):
        return [], [], {}
    elif not names:
        raise ValueError(f"no texture and no vertex colours ({contents.hint}); pass --texture IMAGE")
    for part in contents.parts:
        if part.uvs is None and part.material in wanted and len(part.faces):
            raise ValueError(f"{part.name!r} has a texture but no texture coordinates; unwrap it first")

    images, textures = [], []
    encoded = {
        name: _encoded(contents, name, len(names)) if override is None else read_file(override)
        for name in names
    }
    check_together(encoded)
    for name, content in encoded.items():
        rgb, alpha = decode_image(content, name)
        images.append(rgb)
        textures.append(Texture(name, alpha, flat=False, made_from=told_of(content, name)))
    texture_of = {m: names.index(name) for m, name in wanted.items()}
    for material in used:
        if material not in texture_of:
            texture_of[material] = len(images)
            color = np.rint(255 * np.array(contents.materials[material].color)).astype(np.uint8)
            images.append(np.tile(color, (4, 4, 1)))
            textures.append(Texture(contents.materials[material].name, None, flat=True))
    return images, textures, texture_of


def _encoded(contents: Contents, name: str, count: int) -> bytes:
    """A base colour image. --texture is advised where it helps: it takes the place of one image alone."""
    try:
        return contents.load_image(name)
    except FileNotFoundError as fault:
        named = str(fault.filename)
        where = "beside the mesh" if is_absolute(named) or not re.search(r"[/\\]", named) else "there"
        other = ", or pass --texture" if count == 1 else ""
        raise BadFile(f"{quoted(named)} does not exist; put it {where}{other}") from fault


def _assemble(
    path: Path,
    contents: Contents,
    images: list[UInt8[Any, "_ _ 3"]],
    textures: list[Texture],
    texture_of: dict[int, int],
) -> Asset:
    """Parts stacked, repaired, and their corners coloured."""
    parts = [part for part in contents.parts if len(part.faces)]
    offsets = np.cumsum([0, *(len(part.positions) for part in parts)])
    faces = np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=False)])
    points = np.concatenate([part.positions for part in parts])
    fixed = repair(points, faces)
    corners = faces[fixed.sources]
    materials = np.repeat([part.material for part in parts], [len(part.faces) for part in parts])

    uvs = np.concatenate([np.zeros((len(p.positions), 2)) if p.uvs is None else p.uvs for p in parts])
    colors = np.concatenate(
        [
            np.tile(np.array(contents.materials[p.material].color, np.float32), (len(p.positions), 1))
            if p.colors is None
            else p.colors
            for p in parts
        ]
    )
    texture_of_material = np.array([texture_of.get(m, 0) for m in range(len(contents.materials))])
    mesh = TexturedMesh(
        vertices=fixed.vertices,
        faces=fixed.faces,
        corner_uvs=uvs[corners] if images else np.zeros((len(corners), 3, 2)),
        face_textures=texture_of_material[materials[fixed.sources]],
        textures=tuple(images),
        corner_colors=np.zeros((len(corners), 3, 3), np.float32) if images else colors[corners],
    )
    _check_measures(mesh)
    paints = [_paint(m, texture_of.get(i, -1), textures) for i, m in enumerate(contents.materials)]
    return Asset(
        path=path,
        mesh=mesh,
        report=_report(path, contents, parts, mesh, textures, fixed),
        parts=tuple(parts),
        paints=tuple(paints),
        textures=tuple(textures),
        corner_vertices=corners,
        container=contents.container,
        digest=_digest(mesh),
    )


def _paint(material: Material, texture: int, textures: list[Texture]) -> Paint:
    """Alpha counts where the material says so: a picture's own alpha may be anything that was left there."""
    own = texture >= 0 and material.opacity_image == textures[texture].name
    alpha = textures[texture].alpha if own else None
    mode = "OPAQUE" if alpha is None else "MASK" if np.isin(alpha, (0, 255)).all() else "BLEND"
    mode = "BLEND" if material.opacity < 1 else mode
    return Paint(material.name, texture, material.color, material.opacity, mode)


def _check_measures(mesh: TexturedMesh) -> None:
    """The surface has an area, and shows each texel so often at most that it can be painted."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    if not np.linalg.norm(np.cross(b - a, c - a), axis=1).max() > 0:
        raise ValueError("every face has zero area; export it again, or scale it up")
    tiles = np.abs(uv_areas(mesh)).sum()
    if tiles > MOST_TILES:
        raise ValueError(
            f"the surface covers its textures {tiles:.0f} times, more than {MOST_TILES:.0f}; unwrap it anew"
        )


def _digest(mesh: TexturedMesh) -> str:
    """The content of the mesh: what prepared tables and runs depend on, wherever the file lies."""
    digest = hashlib.sha256()
    for array in (*mesh[:4], *mesh.textures, mesh.corner_colors):
        digest.update(f"{array.dtype}{array.shape}".encode() + np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _report(
    path: Path,
    contents: Contents,
    parts: list[Part],
    mesh: TexturedMesh,
    textures: list[Texture],
    fixed: Repaired,
) -> Report:
    outside = ((mesh.corner_uvs < 0) | (mesh.corner_uvs > 1)).any((1, 2))
    painted = ~np.array([t.flat for t in textures] or [True])[mesh.face_textures]
    return Report(
        path=str(path),
        format=path.suffix[1:].upper(),
        parts=len(parts),
        materials=len({part.material for part in parts}),
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
        textures=tuple(map(_told, textures, mesh.textures)),
        missing_images=contents.missing_images,
        ignored_options=contents.ignored_options,
        found_images=contents.found_images,
        unread=contents.unread,
    )


def _told(texture: Texture, image: UInt8[Any, "H W 3"]) -> str:
    was = " (flat)" if texture.flat else f", made from {texture.made_from}" * bool(texture.made_from)
    return f"{texture.name}: {image.shape[1]} × {image.shape[0]}{was}"


# ---------------------------------------------------------------------------------------------- writing
