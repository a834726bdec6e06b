"""An asset with new maps as GLB, as OBJ (with MTL and PNG) or as PLY.

An asset that was GLB or OBJ and keeps its format is the same file with new maps (`formats.glb`,
`formats.obj_source`). Otherwise the file is new, from the triangles of the asset's parts: names of parts and
materials are kept, node transforms are applied, numbers are exact; `flx.assets.preflight` lists what a
format cannot hold. Every file is written whole or not at all, and the OBJ after the files that it names.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Num, UInt8

from flx.arguments import path_of
from flx.assets.asset import Asset, Images, Painting, check_asset, check_painting, own_painting
from flx.assets.formats import glb, obj_source
from flx.assets.formats.gltf import Gltf
from flx.assets.formats.images import encode_png
from flx.assets.formats.obj_source import ObjSource, only_object
from flx.assets.formats.parts import stacked
from flx.files import write_atomically
from flx.geometry.color import quantized
from flx.types import Slot

SUFFIXES = (".glb", ".obj", ".ply")
BLOCK = 1 << 14  # rows written at a time


def write(asset: Asset, painting: Painting, path: str | Path) -> None:
    """Write the asset with new maps, each file whole or not at all.

    Args:
        asset: The mesh file; geometry, UVs, materials and names are written as they were read.
        painting: New images or vertex colours. Maps that it leaves out stay as they are, byte for byte in an
            asset that was a GLB or glTF. Alpha is kept.
        path: The suffix chooses the format: .glb; .obj, with an MTL and a PNG for each painted texture next
            to it; .ply, for colours of vertices alone.

    Raises ValueError for another suffix, where the format cannot hold the painting, where an image is
    missing, and where an OBJ would overwrite a file of the asset.

    Example:
        flx.save(asset, painting, "variation.glb")
    """
    path = path_of("path", path, "a file to write, such as 'new.glb'")
    check_asset("asset", asset)
    check_painting("painting", painting)
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{path} has no suffix of {', '.join(SUFFIXES)}; it chooses the format")
    if path.is_dir():
        raise ValueError(f"{path} is a folder; name a file in it")
    _check_painting(asset, painting, path)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".ply":
        _write_ply(asset, painting.colors, path)
    elif path.suffix != ".obj":
        write_atomically(path, glb.glb_bytes(painted_gltf(asset, painting)))
    else:
        check_room(asset, path)
        (_write_obj if asset.textures else _write_obj_colors)(asset, painting, path)


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
        raise ValueError(f"{asset.path} has textures, a PLY only vertex colours; write a GLB or OBJ")
    if asset.textures:
        if not painting.maps or (path.suffix == ".obj" and not painting.images):
            raise ValueError(f"no base colour image for {asset.path}; give one for each of its textures")
    elif len(painting.colors) != asset.report.vertices_read and (len(painting.colors) or not others):
        wanted = f"{asset.report.vertices_read} vertices of {asset.path}"
        raise ValueError(f"{len(painting.colors)} colours for the {wanted}; give one for each")


def _write_obj(asset: Asset, painting: Painting, path: Path) -> None:
    files = _image_files(asset, path)
    for index, file in files.items():
        image = encode_png(painting.images[index], asset.textures[index].alpha)
        write_atomically(path.with_name(file), image)
    if isinstance(asset.container, ObjSource):
        fresh = _fresh_name(asset, asset.container)
        obj_source.write_painted(asset.container, _painted(asset, files), fresh, path)
        return
    library, names = [], _words(paint.name for paint in asset.paints)
    for number in sorted({part.material for part in asset.parts}):
        name, paint = names[number], asset.paints[number]
        color = (1.0, 1.0, 1.0) if paint.texture in files else paint.color
        library += [f"newmtl {name}", "Kd {} {} {}".format(*map(float, color))]
        library += [f"map_Kd {files[paint.texture]}"] if paint.texture in files else []
    write_atomically(path.with_suffix(".mtl"), ("\n".join(library) + "\n").encode())
    write_atomically(path, "\n".join(_obj_lines(asset, path.with_suffix(".mtl").name)).encode())


def _write_obj_colors(asset: Asset, painting: Painting, path: Path) -> None:
    """An OBJ with an sRGB colour after each position, which most readers understand."""
    if isinstance(asset.container, ObjSource):
        used = np.unique(asset.corner_vertices)  # vertices that lost all faces to repair have no colour
        obj_source.write_colored(asset.container, asset.container.rows[used], painting.colors[used], path)
    else:
        write_atomically(path, "\n".join(_obj_lines(asset, None, painting.colors)).encode())


def _image_files(asset: Asset, path: Path) -> dict[int, str]:
    """A PNG's name for each texture that is not flat. None has the name of a map of the asset."""
    maps = asset.container.maps.values() if isinstance(asset.container, ObjSource) else ()
    taken, files = {name.lower() for name in maps}, {}
    for index, texture in enumerate(asset.textures):
        name = f"{path.stem}_{index}" if len(asset.textures) > 1 else path.stem
        while f"{name}.png".lower() in taken:
            name += "_new"
        if not texture.flat:
            files[index] = f"{name}.png"
    return files


def _painted(asset: Asset, files: dict[int, str]) -> dict[str, str]:
    """The image file of each material that has one; "" stands for faces without a material."""
    names = [*(paint.name for paint in asset.paints[:-1]), ""]
    return {n: files[p.texture] for n, p in zip(names, asset.paints, strict=True) if p.texture in files}


def _fresh_name(asset: Asset, source: ObjSource) -> str:
    """A new name for the material of faces that have none."""
    taken, name = {paint.name for paint in asset.paints[:-1]}, _word(asset.path.stem)
    taken |= obj_source.material_names(source)
    while name in taken:
        name += "_"
    return name


def other_files(asset: Asset, source: ObjSource) -> list[str]:
    """The files that the libraries of an OBJ name, except the images that are replaced."""
    return obj_source.other_names(source, _painted(asset, _image_files(asset, asset.path)))


def check_room(asset: Asset, path: Path, beside: Sequence[Path] = ()) -> None:
    """Raises ValueError if writing to `path` (with the files `beside` it) would overwrite a file of the
    asset, or if a different file already has the place of one of its maps."""
    source, files = asset.container, [path, *beside]
    images = [texture.name for texture in asset.textures if not texture.flat]
    # Images stand next to the mesh, or come from --texture.
    own = [asset.path, *(asset.path.parent / name for name in images), *map(Path, images)]
    if path.suffix == ".obj":
        files += [path.with_suffix(".mtl"), *map(path.with_name, _image_files(asset, path).values())]
    if isinstance(source, ObjSource):
        own += [source.folder / name for name in (*source.libraries, *source.maps)]
        if path.suffix == ".obj":
            files += obj_source.library_files(source, path).values()
            others = [name for name in other_files(asset, source) if name in source.maps]
            obj_source.check_maps(source, others, path.parent)
            own += [path.parent / source.maps[name] for name in others]
    taken = {file.resolve() for file in own}
    for file in files:
        if file.resolve() in taken:
            raise ValueError(f"{file} would overwrite a file of {asset.path}; name another --out")


def _write_ply(asset: Asset, colors: Float32[Any, "V 3"], path: Path) -> None:
    """One binary PLY; positions in float64 where float32 would round them."""
    points, part_faces = stacked(asset.parts)
    kind = "<f4" if (points.astype(np.float32) == points).all() else "<f8"
    columns = [(axis, kind, points[:, k]) for k, axis in enumerate("xyz")]
    known = [part.normals for part in asset.parts if part.normals is not None]
    if len(known) == len(asset.parts):
        normals = np.concatenate(known)
        columns += [(f"n{axis}", "<f4", normals[:, k]) for k, axis in enumerate("xyz")]
    columns += [(name, "u1", quantized(colors)[:, k]) for k, name in enumerate(("red", "green", "blue"))]
    vertices = np.empty(len(points), [(name, dtype) for name, dtype, _ in columns])
    for name, _, values in columns:
        vertices[name] = values
    faces = np.empty(sum(map(len, part_faces)), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, np.concatenate(part_faces)
    words = {"<f4": "float", "<f8": "double", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", "comment flx", f"element vertex {len(points)}"]
    header += [f"property {words[dtype]} {name}" for name, dtype, _ in columns]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    write_atomically(path, "\n".join(header).encode() + vertices.tobytes() + faces.tobytes())


def _obj_lines(asset: Asset, library: str | None, colors: Float32[Any, "V 3"] | None = None) -> Iterator[str]:
    """The text of an OBJ, in blocks of lines; texture coordinates run up there."""
    yield from ["# flx", *([f"mtllib {library}"] if library else [])]
    rows, part_faces = stacked(asset.parts)
    yield from _numbers("v", rows if colors is None else np.concatenate([rows, colors], 1))
    materials, normals, uvs = _words(paint.name for paint in asset.paints), 0, 0
    names = _words(part.name for part in asset.parts)
    for part, name, faces in zip(asset.parts, names, part_faces, strict=True):
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
            yield f"usemtl {materials[part.material]}"
        between = "//" if part.uvs is None else "/"
        face = "f " + " ".join([between.join(["%d"] * len(corners))] * 3)
        yield from _rows(face.__mod__, np.stack(corners, -1).reshape(len(faces), -1))
    yield ""


def _numbers(key: str, rows: Float64[Any, "N K"]) -> Iterator[str]:
    return _rows(lambda row: f"{key} " + " ".join(map(repr, row)), rows)


def _rows(line: Callable[[tuple], str], rows: Num[Any, "N K"]) -> Iterator[str]:
    """A line for each row, in blocks: as Python numbers, rows take ten times the memory of the text."""
    for start in range(0, len(rows), BLOCK):
        yield "\n".join(line(tuple(row)) for row in rows[start : start + BLOCK].tolist())


def _words(names: Iterable[str]) -> list[str]:
    """A unique word for each name."""
    words: dict[str, None] = {}
    for number, word in enumerate(map(_word, names)):
        while word in words:
            word += f"_{number}"
        words[word] = None
    return list(words)


def _word(name: str) -> str:
    return re.sub(r"\s+", "_", name.strip()) or "unnamed"


def painted_gltf(asset: Asset, painting: Painting) -> Gltf:
    """The asset's own glTF with other images or vertex colours, or a new one. Images that stand for a
    material's flat value are not written."""
    file = asset.container
    ends = np.cumsum([len(part.positions) for part in asset.parts])
    wanted = painting.colors if len(painting.colors) else own_painting(asset).colors
    colors = None if asset.textures else np.split(wanted, ends[:-1])
    own: dict[Slot, Images] = {slot: layer.images for slot, layer in asset.mesh.maps.items()}
    maps: dict[Slot, Images] = {**({} if isinstance(file, Gltf) else own), **painting.maps}
    pngs: dict[Slot, dict[int, bytes]] = {}
    for slot, images in maps.items():
        pngs[slot] = encoded(asset, slot, images)
    if not isinstance(file, Gltf):
        name = only_object(file) if isinstance(file, ObjSource) else ""
        return glb.build_gltf(name or asset.path.stem, asset.parts, asset.paints, pngs, colors)
    if colors is not None and len(painting.colors):
        origins = [part.origin for part in asset.parts]
        file = glb.replace_colors(file, dict(zip(origins, colors, strict=True)))
    for slot, images in pngs.items():
        used = ((m, paint.textures.get(slot, -1)) for m, paint in enumerate(asset.paints))
        shown = {material: index for material, index in used if index in images}
        file = glb.replace_images(file, slot, shown, images)
    return file


def encoded(asset: Asset, slot: Slot, images: Images) -> dict[int, bytes]:
    """New images of a slot as PNGs with the alpha of the old; none for those that are flat."""
    textures = enumerate(asset.sources[slot])
    return {i: encode_png(images[i], t.alpha) for i, t in textures if not t.flat}


def write_atlases(asset: Asset, painting: Painting, path: Path) -> None:
    """The new base colours as PNGs named after the mesh at `path`; not for an OBJ, which has its own."""
    for index, file in atlas_files(asset, path).items():
        write_png(file, painting.images[index])


def atlas_files(asset: Asset, path: Path) -> dict[int, Path]:
    """The file that `write_atlases` makes for each texture that is not flat."""
    names = {} if path.suffix == ".obj" else _image_files(asset, path)
    return {index: path.with_name(name) for index, name in names.items()}


def write_png(path: Path, image: UInt8[Any, "H W 3"]) -> None:
    """A PNG, whole or not at all."""
    write_atomically(path, encode_png(image, None))
