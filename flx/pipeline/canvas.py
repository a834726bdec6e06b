"""From latents to an asset: colours decoded wherever the asset shows them, in files and in pictures."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Complex64, Float32, Int, Int32, UInt8
from PIL import Image

from flx.arguments import briefly, check_kind, check_word, whole
from flx.assets.asset import Asset, Painting, check_asset, check_painting, own_painting
from flx.assets.formats.files import limit
from flx.assets.tints import corner_tints, tinted
from flx.geometry import render
from flx.geometry.atlas import Atlas, atlas_texels, fill_gutter
from flx.geometry.color import eight_bits, quantized, resized
from flx.geometry.copies import Copy, queries_at
from flx.geometry.sampling import transfer
from flx.geometry.tangent import tangent_frames
from flx.pipeline.codec import Codec
from flx.types import Queries, Slot, SurfacePoints, TexturedMesh, Triangulation

LARGEST = 2048  # most pixels on the longer side of an atlas whose size is not given
SMALLEST = 16  # least pixels that may be given
GUTTER = 1 / 32  # share of an atlas that is filled around charts: enough for mipmaps of 32 pixels and more
CHUNK = 1 << 18  # texels decoded at a time
VIEWS = ((30.0, 20.0), (210.0, 20.0))  # azimuth, elevation in degrees


class Canvas(NamedTuple):
    """Where an asset shows colours, and where that is on the triangulation that carries the latents.

    It takes 16 bytes a texel; the decoder's other inputs are made chunk by chunk.
    """

    asset: Asset
    triangulation: Triangulation
    atlases: tuple[Atlas | None, ...]  # None: a flat material, left alone
    faces: Int32[Any, "P"]  # of the triangulation; the texels of all atlases in turn, or the vertices
    barycentrics: Float32[Any, "P 3"]
    slot: Slot = "base_color"  # the map whose texels they are


def open_canvas(
    asset: Asset, triangulation: Triangulation, texture_size: int | None = None, slot: Slot = "base_color"
) -> Canvas:
    """Find every texel of one of the asset's maps (or every vertex) on the triangulation.

    `texture_size`: pixels on the longer side; None: as the input has, at most `LARGEST`.
    """
    mesh = asset.mesh
    atlases = atlases_of(asset, [atlas_size(i, texture_size) for i in mesh.maps[slot].images], slot)
    count = sum(int(atlas.covered.sum()) for atlas in atlases if atlas) or len(_vertex_points(asset)[0])
    faces, barycentrics, start = np.empty(count, np.int32), np.empty((count, 3), np.float32), 0
    for points in _shown_points(asset, atlases):
        hits = transfer(points, mesh, triangulation)
        chunk = slice(start, start + len(hits.faces))
        faces[chunk], barycentrics[chunk] = hits
        start = chunk.stop
    return Canvas(asset, triangulation, atlases, faces, barycentrics, slot)


def atlases_of(
    asset: Asset, sizes: Iterable[tuple[int, ...]], slot: Slot = "base_color"
) -> tuple[Atlas | None, ...]:
    """The texels of each image of a map at a size (height, width); None where it is flat."""
    textures = enumerate(zip(asset.sources[slot], sizes, strict=True))
    return tuple(
        None if texture.flat else atlas_texels(asset.mesh, index, height, width, slot)
        for index, (texture, (height, width)) in textures
    )


def _shown_points(asset: Asset, atlases: Sequence[Atlas | None]) -> Iterator[SurfacePoints]:
    if not atlases:
        yield _vertex_points(asset)[1]
    for atlas in filter(None, atlases):
        texels = atlas.texels
        for start in range(0, len(texels), CHUNK):
            yield atlas.points_at(texels[start : start + CHUNK])


def check_size(texture_size: int | None, name: str = "--texture-size") -> None:
    """Raises ValueError for fewer pixels than the metrics need, or more than an image may have.

    `name` is what the caller calls it.
    """
    longest = int(limit("FLX_MAX_PIXELS") ** 0.5)
    texture_size = None if texture_size is None else whole(name, texture_size)
    if texture_size is not None and not SMALLEST <= texture_size <= longest:
        raise ValueError(f"{name} is {texture_size}; give {SMALLEST} to {longest} pixels")


def atlas_size(image: UInt8[Any, "H W 3"], texture_size: int | None) -> tuple[int, int]:
    """Height and width of a new atlas: the input's proportions, `texture_size` on the longer side."""
    longer = max(image.shape[:2])
    wanted = texture_size or min(longer, LARGEST)
    height, width = (max(1, round(side * wanted / longer)) for side in image.shape[:2])
    return height, width


def paint(
    asset: Asset, copy: Copy, codec: Codec, latents: Complex64[Any, "V D"], texture_size: int | None = None
) -> Painting:
    """New textures on the asset's own UVs (or colours at its vertices), decoded from codes.

    Args:
        asset: The mesh file to paint; it is not changed.
        copy: The triangulation that carries the codes, from `flx.triangulate` or `generator.home`.
        codec: The FL-VAE.
        latents: A code at each vertex of the copy, [V, D] complex64: `codec.encode(copy.rings)` for the
            asset's own texture, `generator.sample(key)` for a new one.
        texture_size: Pixels on the longer side; the input's, at most 2048, unless given.

    Raises ValueError for a size that is too small or too large, and where a vertex has no code.

    Example:
        painting = flx.paint(asset, copy, codec, codec.encode(copy.rings))
        flx.save(asset, painting, "back.glb")
    """
    check_asset("asset", asset)
    if not hasattr(copy, "triangulation"):
        raise ValueError(f"copy is {briefly(copy)}; give what flx.triangulate returns, or generator.home")
    check_kind("codec", codec, Codec, "what flx.load_codec returns")
    check_size(texture_size, "texture_size")
    latents = np.asarray(latents) if isinstance(latents, list | tuple) else latents
    if np.shape(latents) != (vertices := len(copy.triangulation.vertices), codec.config.latents):
        raise ValueError(
            f"latents have shape {list(np.shape(latents))}; give [{vertices}, {codec.config.latents}]: "
            "a code for each vertex of the copy"
        )
    codes = np.asarray(latents)
    if codes.dtype.kind not in "iufc" or not np.isfinite(codes).all():
        raise ValueError(f"latents ({codes.dtype}) are not all finite numbers; give the codes of a codec")
    return bake(open_canvas(asset, copy.triangulation, texture_size), codec.decoder(latents))


def bake(
    canvas: Canvas,
    painter: Callable[[Queries], Float32[Any, "N 3"]],
    finish: Callable[[Int[Any, "N"], Float32[Any, "N 3"]], Float32[Any, "N 3"]] | None = None,
) -> Painting:
    """The colours that `painter` gives `chunks`: images with filled gutters, or colours at vertices.

    `finish` makes an image's numbers of what the painter gives, with the faces of the asset that are there.
    """
    asset, colors = canvas.asset, map(painter, chunks(canvas))
    if not canvas.atlases:
        whole = own_painting(asset).colors
        whole[_vertex_points(asset)[0]] = np.concatenate(list(colors))
        return Painting({}, whole)
    images = []
    for atlas, image in zip(canvas.atlases, asset.mesh.maps[canvas.slot].images, strict=True):
        if atlas is None:
            images.append(image)
            continue
        new, texels = resized(eight_bits(image), atlas.height, atlas.width).copy(), atlas.texels
        for start in range(0, len(texels), CHUNK):
            chunk = texels[start : start + CHUNK]
            found = next(colors)
            found = finish(atlas.faces.ravel()[chunk], found) if finish else found
            new.reshape(-1, 3)[chunk] = quantized(found)
        images.append(fill_gutter(new, atlas.covered, max(2.0, GUTTER * max(atlas.height, atlas.width))))
    return Painting({canvas.slot: tuple(images)})


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


def shown(asset: Asset, painting: Painting) -> TexturedMesh:
    """The asset's surface with new maps, for rendering."""
    mesh = asset.mesh
    for slot, images in painting.maps.items():
        mesh = mesh.with_layer(slot, images=tuple(images))
    return mesh if asset.textures else mesh._replace(corner_colors=painting.colors[asset.corner_vertices])


def picture(asset: Asset, *paintings: Painting, up: Literal["y", "z"] = "y", size: int = 384) -> Image.Image:
    """A picture of the asset and of each painting of it, side by side, from two sides.

    Args:
        asset: The mesh file.
        paintings: New textures of it, from `flx.paint` or `flx.generate`.
        up: The axis that points up.
        size: Pixels of one view.

    Example:
        flx.picture(asset, *flx.generate(generator, count=3))
    """
    check_asset("asset", asset)
    for n, painting in enumerate(paintings):
        check_painting(f"painting {n}", painting)
    check_word("up", up, ("y", "z"))
    size, captions = whole("size", size, SMALLEST), [str(n) for n in range(len(paintings))]
    return Image.fromarray(side_by_side(asset, paintings, captions, up, size))


def side_by_side(
    asset: Asset,
    paintings: Sequence[Painting],
    captions: Sequence[str],
    up: str,
    size: int = 384,
    own: Asset | None = None,
) -> UInt8[Any, "_ _ 3"]:
    """Renders of the input and of each new texture in columns, as viewers show them, a view in each row.

    `own` is the input, if the asset is another mesh.
    """
    meshes, own = [tinted(asset, shown(asset, painting)) for painting in paintings], own or asset
    before, rows = tinted(own, own.mesh), []
    tints, own_tints = corner_tints(asset), corner_tints(own)
    for view in VIEWS:
        first, others = (render.look(one.mesh, *view, size, up) for one in (own, asset))  # pyright: ignore
        input_view = render.show(first, before, own_tints)
        rows.append([input_view, *(render.show(others, mesh, tints) for mesh in meshes)])
    return render.contact_sheet(rows, ["input", *captions])


def _vertex_points(asset: Asset) -> tuple[np.ndarray, SurfacePoints]:
    """The original vertices that faces use, and one corner of the surface where each is."""
    vertices, first = np.unique(asset.corner_vertices, return_index=True)
    return vertices, SurfacePoints(first // 3, np.eye(3)[first % 3])
