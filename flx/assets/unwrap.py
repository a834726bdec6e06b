"""An atlas for a mesh with colours at its vertices and no texture coordinates, by xatlas (the extra `uv`)."""

import importlib.util
import sys

import numpy as np
from jaxtyping import Float64, Int

from flx.assets.asset import Asset, Format, Texture
from flx.assets.formats.gltf import Gltf
from flx.assets.formats.obj_source import ObjSource
from flx.assets.formats.parts import Part
from flx.geometry.atlas import atlas_texels, paint
from flx.geometry.sampling import surface_colors
from flx.types import Layer

INSTALL = "pip install '.[uv]' in the clone"
NEW_CHARTS = "charts by xatlas"  # what a texture is made from that lies on them
PADDING = 4  # texels between charts on a texture of about 1024²: seams stay closed down to a quarter of it


def is_unwrappable(asset: Asset) -> bool:
    """Whether the asset has vertex colours and is not a glTF by another program, which would lose content."""
    file = asset.container
    is_foreign = isinstance(file, Gltf) and file.document["asset"].get("generator") != "flx"
    return not asset.textures and not is_foreign


def unwrapped(asset: Asset) -> Asset:
    """The asset with charts, and its vertex colours painted on one texture.

    The triangles, except those that repair dropped, keep their order and normals; vertices on the rims of
    charts are duplicated. Raises ValueError where xatlas is not installed or leaves faces out.
    """
    try:
        import xatlas  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise ValueError(f"{asset.path} has no texture coordinates; {INSTALL} makes them") from None
    mesh, charts, options = asset.mesh, xatlas.Atlas(), xatlas.PackOptions()
    options.padding = PADDING
    middle, size = mesh.vertices.mean(0), np.ptp(mesh.vertices, axis=0).max()
    charts.add_mesh(((mesh.vertices - middle) / size).astype(np.float32), mesh.faces.astype(np.uint32))
    charts.generate(pack_options=options)
    vertices, faces, uvs = charts[0]
    if faces.shape != mesh.faces.shape or (vertices[faces] != mesh.faces).any():
        raise ValueError(f"{asset.path} cannot be unwrapped: xatlas left faces out; unwrap it elsewhere")
    faces, uvs = faces.astype(np.int64), uvs.astype(np.float64)

    layer = Layer((), np.zeros(len(faces), np.int64), uvs[faces])
    charted = mesh._replace(maps={"base_color": layer}, corner_colors=np.zeros_like(mesh.corner_colors))
    atlas = atlas_texels(charted, 0, charts.height, charts.width)
    image = paint(atlas, surface_colors(mesh, atlas.points))
    parts, corners = _split(asset, faces, uvs)
    return asset._replace(
        mesh=charted.with_layer(images=(image,)),
        report=asset.report._replace(vertices_read=sum(len(part.positions) for part in parts)),
        parts=parts,
        paints=tuple(paint._replace(textures={"base_color": 0}) for paint in asset.paints),
        sources={"base_color": (Texture("base color", None, flat=False, made_from=NEW_CHARTS),)},
        map_names={},
        corner_vertices=corners,
        container=None,
    )


def _split(
    asset: Asset, charted: Int[np.ndarray, "F 3"], uvs: Float64[np.ndarray, "N 2"]
) -> tuple[tuple[Part, ...], Int[np.ndarray, "F 3"]]:
    """The parts, with a row for each old row and chart it is in; and the new row of each corner."""
    parts, corners = [], np.zeros_like(asset.corner_vertices)
    ends, total = np.cumsum([len(part.positions) for part in asset.parts]), 0
    part_of = np.searchsorted(ends, asset.corner_vertices[:, 0], side="right")
    for number, part in enumerate(asset.parts):
        chosen = part_of == number
        old = asset.corner_vertices[chosen] - (ends[number] - len(part.positions))
        keys, rows = np.unique(old * len(uvs) + charted[chosen], return_inverse=True)
        rows, (source, chart) = rows.reshape(-1, 3), np.divmod(keys, len(uvs))
        parts.append(part.at(source, rows)._replace(uvs=uvs[chart], colors=None, origin=(-1, -1)))
        corners[chosen] = rows + total
        total += len(source)
    return tuple(parts), corners


def prepared_for(asset: Asset, format: Format) -> Asset:
    """The asset, with an atlas if it has vertex colours, `format` allows one and xatlas is installed.

    An OBJ that is written as OBJ stays as it is, since an atlas needs other rows.
    """
    stays = format == "obj" and isinstance(asset.container, ObjSource)
    if format == "ply" or stays or not is_unwrappable(asset):
        return asset
    if importlib.util.find_spec("xatlas") is None:
        print(f"{asset.path}: new colours go to its vertices; {INSTALL} for an atlas", file=sys.stderr)
        return asset
    return unwrapped(asset)
