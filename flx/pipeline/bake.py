"""From latents to an asset: colours decoded wherever the asset shows them, in files and in pictures."""

import importlib.util
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Complex64, Float32, Int32, UInt8
from PIL import Image

from flx.mesh.assets import Asset, write_glb, write_glb_colors
from flx.mesh.copies import queries_at, transfer
from flx.mesh.exports import check_room, write_obj, write_obj_colors, write_ply_colors
from flx.mesh.formats.files import limit, write_atomically
from flx.mesh.formats.gltf import Gltf
from flx.mesh.formats.images import quantized
from flx.mesh.formats.obj_source import ObjSource
from flx.mesh.losses import dangling, left_behind
from flx.mesh.render import contact_sheet, look, show
from flx.mesh.tangent import tangent_frames
from flx.mesh.texels import Atlas, atlas_texels, fill_gutter
from flx.mesh.unwrap import INSTALL, is_unwrappable, unwrapped
from flx.pipeline.codec import Codec
from flx.types import Queries, SurfacePoints, TexturedMesh, Triangulation

Format = Literal["glb", "obj", "ply"]
LARGEST = 2048  # pixels on the longer side of an atlas, unless more are asked for
SMALLEST = 16  # that may be asked for
# Of an atlas, filled around charts: enough for its copies of 32 pixels and more.
GUTTER = 1 / 32
CHUNK = 1 << 18  # texels decoded at a time
VIEWS = ((30.0, 20.0), (210.0, 20.0))  # azimuth, elevation in degrees


class Baked(NamedTuple):
    """New colours of an asset: an image for each of its textures, or a colour for each of its vertices."""

    images: tuple[UInt8[Any, "_ _ 3"], ...]
    colors: Float32[Any, "V 3"]


class Canvas(NamedTuple):
    """Where an asset shows colours, and where that is on the triangulation that carries the latents.

    16 bytes a texel: what the decoder asks for besides is made as it is decoded.
    """

    asset: Asset
    triangulation: Triangulation
    atlases: tuple[Atlas | None, ...]  # None: a flat material, left alone
    faces: Int32[Any, "P"]  # of the triangulation; the texels of all atlases in turn, or the vertices
    barycentrics: Float32[Any, "P 3"]


def open_canvas(asset: Asset, triangulation: Triangulation, texture_size: int | None = None) -> Canvas:
    """Find every texel (or vertex) of the asset on the triangulation.

    `texture_size`: pixels on the longer side; None: as the input has, at most `LARGEST`.
    """
    mesh = asset.mesh
    atlases = tuple(
        None if texture.flat else atlas_texels(mesh, index, *atlas_size(image, texture_size))
        for index, (texture, image) in enumerate(zip(asset.textures, mesh.textures, strict=True))
    )
    count = sum(int(atlas.covered.sum()) for atlas in atlases if atlas) or len(_vertex_points(asset)[0])
    faces, barycentrics, start = np.empty(count, np.int32), np.empty((count, 3), np.float32), 0
    for points in _shown_points(asset, atlases):
        hits = transfer(points, mesh.vertices, mesh.faces, triangulation.vertices, triangulation.faces)
        chunk = slice(start, start + len(hits.faces))
        faces[chunk], barycentrics[chunk] = hits
        start = chunk.stop
    return Canvas(asset, triangulation, atlases, faces, barycentrics)


def _shown_points(asset: Asset, atlases: Sequence[Atlas | None]) -> Iterator[SurfacePoints]:
    if not atlases:
        yield _vertex_points(asset)[1]
    for atlas in filter(None, atlases):
        texels = atlas.texels
        for start in range(0, len(texels), CHUNK):
            yield atlas.points_at(texels[start : start + CHUNK])


def check_size(texture_size: int | None) -> None:
    """Raises ValueError for an atlas of fewer pixels than its metrics look at, or more than one may have."""
    longest = int(limit("FLX_MAX_PIXELS") ** 0.5)
    if texture_size is not None and not SMALLEST <= texture_size <= longest:
        raise ValueError(f"--texture-size is {texture_size}; give {SMALLEST} to {longest} pixels")


def atlas_size(image: UInt8[Any, "H W 3"], texture_size: int | None) -> tuple[int, int]:
    """Height and width of a new atlas: the input's shape, its longer side as asked."""
    longer = max(image.shape[:2])
    wanted = texture_size or min(longer, LARGEST)
    height, width = (max(1, round(side * wanted / longer)) for side in image.shape[:2])
    return height, width


def bake(canvas: Canvas, codec: Codec, z: Complex64[Any, "V D"]) -> Baked:
    """Decode the latents at every texel, or at every vertex."""
    return painted(canvas, map(codec.decoder(z), chunks(canvas)))


def painted(canvas: Canvas, colors: Iterator[Float32[Any, "N 3"]]) -> Baked:
    """Colours of the canvas' `chunks` as images with filled gutters, or as colours of vertices."""
    asset = canvas.asset
    if not canvas.atlases:
        whole = _own_colors(asset)
        whole[_vertex_points(asset)[0]] = np.concatenate(list(colors))
        return Baked((), whole)
    images = []
    for atlas, image in zip(canvas.atlases, asset.mesh.textures, strict=True):
        if atlas is None:
            images.append(image)
            continue
        new, texels = resized(image, atlas.height, atlas.width).copy(), atlas.texels
        for start in range(0, len(texels), CHUNK):
            new.reshape(-1, 3)[texels[start : start + CHUNK]] = quantized(next(colors))
        images.append(fill_gutter(new, atlas.covered, max(2.0, GUTTER * max(atlas.height, atlas.width))))
    return Baked(tuple(images), np.zeros((0, 3), np.float32))


def chunks(canvas: Canvas) -> Iterator[Queries]:
    """The points of the canvas, at most `CHUNK` at a time; no chunk crosses from one atlas to the next."""
    frames, start = tangent_frames(canvas.triangulation), 0
    counts = [int(atlas.covered.sum()) for atlas in canvas.atlases if atlas] or [len(canvas.faces)]
    for end in np.cumsum(counts):
        while start < end:
            chunk = slice(start, min(start + CHUNK, int(end)))
            hits = SurfacePoints(canvas.faces[chunk], canvas.barycentrics[chunk].astype(np.float64))
            yield queries_at(hits, canvas.triangulation, frames)
            start = chunk.stop


def bake_back(asset: Asset) -> Baked:
    """The asset's own colours."""
    return Baked(asset.mesh.textures, _own_colors(asset))


def resized(image: UInt8[Any, "H W 3"], height: int, width: int) -> UInt8[Any, "_ _ 3"]:
    """The image at another size, each pixel the mean of what it covers."""
    if image.shape[:2] == (height, width):
        return image
    return np.asarray(Image.fromarray(image).resize((width, height), Image.Resampling.BOX))


def shown(asset: Asset, baked: Baked) -> TexturedMesh:
    """The asset's surface with the new colours, to be rendered."""
    if baked.images:
        return asset.mesh._replace(textures=baked.images)
    return asset.mesh._replace(corner_colors=baked.colors[asset.corner_vertices])


def check_output(asset: Asset, format: Format, paths: Sequence[Path], beside: Sequence[Path] = ()) -> None:
    """Before anything is paid for: can the asset be written to `paths`, with other files `beside` it? Says on
    stderr, in one line, what stays behind and what is not there.

    Raises ValueError for PLY, which holds colours of vertices only, from an asset with textures; where files
    of the asset itself would be overwritten; and where there can be no such folder.
    """
    for folder in {path.parent for path in paths}:
        _check_folder(folder)
    if format == "ply" and asset.textures:
        raise ValueError(
            f"{asset.path} has textures, a PLY has colours of vertices; take --format glb or obj"
        )
    for path in paths:
        check_room(asset, path, beside)
    told = []
    if left := left_behind(asset, format):
        kept = {ObjSource: "; --format obj keeps all", Gltf: "; --format glb keeps all"}
        told.append(f"{left} stay behind{kept.get(type(asset.container), '')}")
    if missing := dangling(asset, format):
        told.append(f"not there, but named in what is written: {missing}")
    if told:
        print(f"{asset.path}: {'; '.join(told)}", file=sys.stderr)


def _check_folder(folder: Path) -> None:
    """Raises ValueError where no folder can be made, or nothing written into it."""
    there = next(parent for parent in (folder, *folder.absolute().parents) if parent.exists())
    if not there.is_dir():
        raise ValueError(f"{there} is a file; name a folder with --out")
    if not os.access(there, os.W_OK | os.X_OK):
        raise ValueError(f"{there} may not be written to; name another folder with --out")


def prepared_for(asset: Asset, format: Format) -> Asset:
    """The asset, with an atlas where it has vertex colours and `format` and installation allow one.

    An OBJ that goes out as OBJ stays as it is, for an atlas needs other rows.
    """
    stays = format == "obj" and isinstance(asset.container, ObjSource)
    if format == "ply" or stays or not is_unwrappable(asset):
        return asset
    if importlib.util.find_spec("xatlas") is None:
        print(f"{asset.path}: new colours go to its vertices; {INSTALL} for an atlas", file=sys.stderr)
        return asset
    return unwrapped(asset)


def write_baked(asset: Asset, baked: Baked, path: Path) -> None:
    """The asset's own geometry, coordinates and materials in the suffix's format, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".obj":
        if baked.images:
            write_obj(asset, baked.images, path)
        else:
            write_obj_colors(asset, baked.colors, path)
    elif path.suffix == ".ply":
        write_ply_colors(asset, baked.colors, path)
    elif baked.images:
        write_glb(asset, baked.images, path)
    else:
        write_glb_colors(asset, baked.colors, path)


def write_atlases(asset: Asset, baked: Baked, path: Path) -> None:
    """The new images as PNGs beside the mesh at `path`, named after it; an OBJ has its own already."""
    for index, image in enumerate(baked.images if path.suffix != ".obj" else ()):
        if not asset.textures[index].flat:
            suffix = f"_{index}" if len(baked.images) > 1 else ""
            write_png(path.with_name(f"{path.stem}{suffix}.png"), image)


def write_png(path: Path, image: UInt8[Any, "H W 3"]) -> None:
    """A PNG, whole or not at all."""
    write_atomically(path, lambda torn: Image.fromarray(image).save(torn))


def side_by_side(
    asset: Asset, baked: Sequence[Baked], captions: Sequence[str], up: str, size: int = 384
) -> UInt8[Any, "_ _ 3"]:
    """Renders of the input and of each new texture in columns, a view in each row."""
    meshes = [asset.mesh, *(shown(asset, b) for b in baked)]
    views = [look(asset.mesh, a, e, size, up) for a, e in VIEWS]  # pyright: ignore
    rows = [[show(view, mesh) for mesh in meshes] for view in views]
    return contact_sheet(rows, ["input", *captions])


def _vertex_points(asset: Asset) -> tuple[np.ndarray, SurfacePoints]:
    """The original vertices that faces use, and one corner of the surface where each is."""
    vertices, first = np.unique(asset.corner_vertices, return_index=True)
    return vertices, SurfacePoints(first // 3, np.eye(3)[first % 3])


def _own_colors(asset: Asset) -> Float32[Any, "V 3"]:
    colors = np.zeros((asset.report.vertices_read, 3), np.float32)
    colors[asset.corner_vertices.ravel()] = asset.mesh.corner_colors.reshape(-1, 3)
    return colors
