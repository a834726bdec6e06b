"""An asset with new maps as GLB, as OBJ (with MTL and PNG) or as PLY.

What came as GLB or OBJ goes out as the same file (`formats.glb`, `formats.obj_source`), but for its maps. All
else is written anew from the triangles and coordinates of its parts: names of parts and materials are kept,
node transforms are applied, numbers are exact. What the formats cannot say stays behind
(`flx.assets.conversion`). Every file is whole or not there, and the OBJ comes last: it never names what is
not there yet.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int, Num, UInt8
from PIL import Image

from flx.assets.asset import Asset, Images, Painting, own_painting
from flx.assets.formats import glb, obj_source
from flx.assets.formats.gltf import Gltf
from flx.assets.formats.images import encode_png
from flx.assets.formats.obj_source import ObjSource, only_object
from flx.files import write_atomically
from flx.geometry.color import quantized
from flx.types import Slot

BLOCK = 1 << 14  # rows written at a time


def write(asset: Asset, painting: Painting, path: str | Path) -> None:
    """Write the asset with new maps, each file whole or not at all.

    Args:
        asset: The mesh file; geometry, UVs, materials and names are written as they were read.
        painting: New images or vertex colours. Maps that it leaves out stay as they are, byte for byte in an
            asset that was a GLB or glTF. Alpha is kept.
        path: The suffix chooses the format: .glb; .obj, with an MTL and a PNG for each painted texture next
            to it; .ply, for colours of vertices alone.

    Raises ValueError where the format cannot hold the painting, where an image is missing, and where an OBJ
    would overwrite a file of the asset.

    Example:
        flx.save(asset, painting, "variation.glb")
    """
    path = Path(path)
    _check_painting(asset, painting, path)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".ply":
        _write_ply(asset, painting.colors, path)
    elif path.suffix != ".obj":
        write_atomically(path, glb.glb_bytes(_painted_gltf(asset, painting)))
    elif asset.textures:
        _write_obj(asset, painting.images, path)
    else:
        _write_obj_colors(asset, painting.colors, path)


def _check_painting(asset: Asset, painting: Painting, path: Path) -> None:
    for slot, images in painting.maps.items():
        if slot not in asset.sources:
            raise ValueError(f"{asset.path} was read without its {slot} map; read it with slots=[{slot!r}]")
        if len(images) != (count := len(asset.sources[slot])):
            where = f"the {count} {slot} images of {asset.path}"
            raise ValueError(f"{len(images)} images for {where}; give one for each")
    others = ", ".join(slot for slot in painting.maps if slot != "base_color")
    if others and path.suffix in (".obj", ".ply"):
        format = path.suffix[1:].upper()
        raise ValueError(f"{path.name}: flx cannot write {others} maps as {format}; write a GLB")
    if path.suffix == ".ply" and asset.textures:
        raise ValueError(f"{asset.path} has textures, a PLY has colours of vertices; write a GLB or OBJ")
    if asset.textures:
        if not painting.maps or (path.suffix == ".obj" and not painting.images):
            raise ValueError(f"no base colour image for {asset.path}; give one for each of its textures")
    elif len(painting.colors) != asset.report.vertices_read and (len(painting.colors) or not others):
        wanted = f"{asset.report.vertices_read} vertices of {asset.path}"
        raise ValueError(f"{len(painting.colors)} colours for the {wanted}; give one for each")


def _write_obj(asset: Asset, images: Images, path: Path) -> None:
    check_room(asset, path)
    files = image_files(asset, path)
    for index, file in files.items():
        write_atomically(path.with_name(file), encode_png(images[index], asset.textures[index].alpha))
    if isinstance(asset.container, ObjSource):
        obj_source.write_painted(asset.container, _painted(asset, files), _fresh_name(asset), path)
        return
    library, used = [], {part.material for part in asset.parts}
    for number, (name, paint) in enumerate(zip(_material_names(asset), asset.paints, strict=True)):
        if number not in used:
            continue
        color = (1.0, 1.0, 1.0) if paint.texture in files else paint.color
        library += [f"newmtl {name}", "Kd {} {} {}".format(*map(float, color))]
        library += [f"map_Kd {files[paint.texture]}"] if paint.texture in files else []
    write_atomically(path.with_suffix(".mtl"), ("\n".join(library) + "\n").encode())
    write_atomically(path, "\n".join(_obj_lines(asset, path.with_suffix(".mtl").name)).encode())


def _write_obj_colors(asset: Asset, colors: Float32[Any, "V 3"], path: Path) -> None:
    """An OBJ with an sRGB colour after each position, as most readers take it."""
    check_room(asset, path)
    if isinstance(asset.container, ObjSource):
        used = np.unique(asset.corner_vertices)  # repair dropped the faces of others: they have no colour
        obj_source.write_colored(asset.container, asset.container.rows[used], colors[used], path)
    else:
        write_atomically(path, "\n".join(_obj_lines(asset, None, colors)).encode())


def image_files(asset: Asset, path: Path) -> dict[int, str]:
    """The PNG beside an OBJ for each texture that is not flat. None is called like a map of the asset."""
    taken = set(asset.container.maps.values()) if isinstance(asset.container, ObjSource) else set()
    taken = {name.lower() for name in taken}
    files = {}
    for index, texture in enumerate(asset.textures):
        name = f"{path.stem}_{index}" if len(asset.textures) > 1 else path.stem
        while f"{name}.png".lower() in taken:
            name += "_new"
        if not texture.flat:
            files[index] = f"{name}.png"
    return files


def _painted(asset: Asset, files: dict[int, str]) -> dict[str, str]:
    """The image file of each material that shows one; "" for the faces that have no material."""
    names = [*(paint.name for paint in asset.paints[:-1]), ""]
    return {n: files[p.texture] for n, p in zip(names, asset.paints, strict=True) if p.texture in files}


def _fresh_name(asset: Asset) -> str:
    """A name for the material of faces that have none."""
    taken, name = {paint.name for paint in asset.paints[:-1]}, _word(asset.path.stem)
    if isinstance(asset.container, ObjSource):
        taken |= obj_source.material_names(asset.container)
    while name in taken:
        name += "_"
    return name


def names_beside(asset: Asset, source: ObjSource) -> list[str]:
    """The files that the libraries of an OBJ name, besides the images that are painted anew."""
    return obj_source.other_names(source, _painted(asset, image_files(asset, asset.path)))


def check_room(asset: Asset, path: Path, beside: Sequence[Path] = ()) -> None:
    """Raises ValueError where writing the asset to `path`, and files `beside` it, would harm others.

    None may be one of the asset's own; and where its maps are to lie nothing else may.
    """
    source, files = asset.container, [path, *beside]
    own = [asset.path, *(asset.path.parent / t.name for t in asset.textures if not t.flat)]
    own += [Path(t.name) for t in asset.textures if not t.flat]  # one that was given stands where it was said
    if path.suffix == ".obj":
        files += [path.with_suffix(".mtl"), *map(path.with_name, image_files(asset, path).values())]
    if isinstance(source, ObjSource):
        own += [source.folder / name for name in (*source.libraries, *source.maps)]
        if path.suffix == ".obj":
            files += obj_source.library_files(source, path).values()
            others = [name for name in names_beside(asset, source) if name in source.maps]
            obj_source.check_maps(source, others, path.parent)
            own += [path.parent / source.maps[name] for name in others]
    taken = {file.resolve() for file in own}
    for file in files:
        if file.resolve() in taken:
            raise ValueError(f"{file} would overwrite a file of {asset.path}; name another --out")


def _write_ply(asset: Asset, colors: Float32[Any, "V 3"], path: Path) -> None:
    """One binary PLY; positions in float64 where float32 would round them."""
    points = np.concatenate([part.positions for part in asset.parts])
    kind = "<f4" if (points.astype(np.float32) == points).all() else "<f8"
    named = {"float": "<f4", "double": "<f8", "uchar": "u1"}
    columns = [(axis, kind, points[:, k]) for k, axis in enumerate("xyz")]
    known = [part.normals for part in asset.parts if part.normals is not None]
    if len(known) == len(asset.parts):
        normals = np.concatenate(known)
        columns += [(f"n{axis}", "<f4", normals[:, k]) for k, axis in enumerate("xyz")]
    columns += [(name, "u1", quantized(colors)[:, k]) for k, name in enumerate(("red", "green", "blue"))]
    vertices = np.empty(len(points), [(name, dtype) for name, dtype, _ in columns])
    for name, _, values in columns:
        vertices[name] = values
    rows = np.concatenate(list(_numbered_faces(asset)))
    faces = np.empty(len(rows), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, rows
    words = {dtype: word for word, dtype in named.items()}
    header = ["ply", "format binary_little_endian 1.0", "comment flx", f"element vertex {len(points)}"]
    header += [f"property {words[dtype]} {name}" for name, dtype, _ in columns]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    write_atomically(path, "\n".join(header).encode() + vertices.tobytes() + faces.tobytes())


def _obj_lines(asset: Asset, library: str | None, colors: Float32[Any, "V 3"] | None = None) -> Iterator[str]:
    """The text of an OBJ, in blocks of lines; texture coordinates run up there."""
    yield from ["# flx", *([f"mtllib {library}"] if library else [])]
    rows = np.concatenate([part.positions for part in asset.parts])
    yield from _numbers("v", rows if colors is None else np.concatenate([rows, colors], 1))
    names, normals, uvs = _material_names(asset), 0, 0
    parts = zip(asset.parts, _words(part.name for part in asset.parts), _numbered_faces(asset), strict=True)
    for part, name, faces in parts:
        corners = [faces + 1]
        if part.uvs is not None:
            yield from _numbers("vt", part.uvs * [1, -1] + [0, 1])
            corners.append(part.faces + uvs + 1)
            uvs += len(part.uvs)
        if part.normals is not None:
            yield from _numbers("vn", part.normals)
            corners.append(part.faces + normals + 1)
            normals += len(part.normals)
        yield f"o {name}"
        if library:
            yield f"usemtl {names[part.material]}"
        between = "//" if part.uvs is None else "/"
        face = "f " + " ".join([between.join(["%d"] * len(corners))] * 3)
        yield from _rows(face.__mod__, np.stack(corners, -1).reshape(len(faces), -1))
    yield ""


def _numbers(key: str, rows: Float64[Any, "N K"]) -> Iterator[str]:
    return _rows(lambda row: f"{key} " + " ".join(map(repr, row)), rows)


def _rows(line: Callable[[tuple], str], rows: Num[Any, "N K"]) -> Iterator[str]:
    """A line for each row. As Python's numbers all rows at once take ten times the memory of the text."""
    for start in range(0, len(rows), BLOCK):
        yield "\n".join(line(tuple(row)) for row in rows[start : start + BLOCK].tolist())


def _numbered_faces(asset: Asset) -> Iterator[Int[Any, "F 3"]]:
    """The faces of each part, with rows counted through the parts."""
    start = 0
    for part in asset.parts:
        yield part.faces + start
        start += len(part.positions)


def _material_names(asset: Asset) -> list[str]:
    return _words(paint.name for paint in asset.paints)


def _words(names: Iterable[str]) -> list[str]:
    """One word for each name, none twice."""
    words: dict[str, None] = {}
    for number, word in enumerate(map(_word, names)):
        while word in words:
            word += f"_{number}"
        words[word] = None
    return list(words)


def _word(name: str) -> str:
    return re.sub(r"\s+", "_", name.strip()) or "unnamed"


def _painted_gltf(asset: Asset, painting: Painting) -> Gltf:
    """The asset's own glTF with other images or vertex colours, or a new one. Images that stood for a
    material's flat value are not written."""
    ends = np.cumsum([len(part.positions) for part in asset.parts])
    wanted = painting.colors if len(painting.colors) else own_painting(asset).colors
    colors = None if asset.textures else np.split(wanted, ends[:-1])
    own: dict[Slot, Images] = {slot: layer.images for slot, layer in asset.mesh.maps.items()}
    rest = {} if isinstance(asset.container, Gltf) else own
    maps: dict[Slot, Images] = {**rest, **painting.maps}
    pngs: dict[Slot, dict[int, bytes]] = {}
    for slot, images in maps.items():
        textures = enumerate(asset.sources[slot])
        pngs[slot] = {i: encode_png(images[i], t.alpha) for i, t in textures if not t.flat}
    file = asset.container
    if not isinstance(file, Gltf):
        return glb.build_gltf(_name(asset), asset.parts, asset.paints, pngs, colors)
    if colors is not None and len(painting.colors):
        origins = [part.origin for part in asset.parts]
        file = glb.replace_colors(file, dict(zip(origins, colors, strict=True)))
    for slot, images in pngs.items():
        shown = {m: paint.textures[slot] for m, paint in enumerate(asset.paints) if slot in paint.textures}
        shown = {material: index for material, index in shown.items() if index in images}
        file = glb.replace_images(file, slot, shown, images)
    return file


def _name(asset: Asset) -> str:
    """What the one object of an OBJ is called; else the file."""
    name = only_object(asset.container) if isinstance(asset.container, ObjSource) else ""
    return name or asset.path.stem


def write_atlases(asset: Asset, painting: Painting, path: Path) -> None:
    """The new base colours as PNGs beside the mesh at `path`, named after it; an OBJ has its own already."""
    for index, image in enumerate(painting.images if path.suffix != ".obj" else ()):
        if not asset.textures[index].flat:
            suffix = f"_{index}" if len(painting.images) > 1 else ""
            write_png(path.with_name(f"{path.stem}{suffix}.png"), image)


def write_png(path: Path, image: UInt8[Any, "H W 3"]) -> None:
    """A PNG, whole or not at all."""
    write_atomically(path, lambda torn: Image.fromarray(image).save(torn))
