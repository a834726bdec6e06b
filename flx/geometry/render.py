"""Pictures of a textured mesh by a NumPy z-buffer: no GL library, no display.

The camera looks at the middle of the mesh from (azimuth, elevation) in degrees. At azimuth 0 it looks along
−z (y up, glTF) or along +y (z up); azimuths grow counter-clockwise seen from above. The bounding sphere of
the mesh fits the view, so every view has the same scale. Light is added and pixels are averaged in linear
light, not in sRGB. Both sides of a face are drawn.
"""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int, UInt8
from PIL import Image, ImageDraw, ImageFont

from flx.geometry.arrays import area_normals, dot, vertex_normals
from flx.geometry.color import linear, srgb
from flx.geometry.raster import Planes, barycentric_planes, pixels_inside
from flx.geometry.sampling import face_normals, surface_colors
from flx.types import Faces, SurfacePoints, TexturedMesh, Vertices

BACKGROUND = 0.94  # grey, sRGB, from which white glaze stands out
FIELD_OF_VIEW = 25.0  # degrees
CREASE = 0.82  # cosine of 35°: a corner that bends more keeps the normal of its face
KEY_LIGHT = np.array([-0.35, 0.5, 0.8])  # over the viewer's left shoulder: right, up, towards the viewer
AMBIENT, SKY, KEY, SHINE = 0.30, 0.16, 0.58, 0.03  # linear light; their sum, the most, is about 1
STEPS = 4095  # size of the tables between sRGB and linear light, less one
MARGIN = 12  # pixels around the pictures of a contact sheet


class View(NamedTuple):
    """What does not depend on a mesh's colours: where rays meet it, and the light at these points."""

    rays: Int[Any, "P"]  # indices of the rays that meet the surface, of (size · supersample)²
    points: SurfacePoints
    light: Float32[Any, "P"]
    gloss: Float32[Any, "P"]
    size: int
    supersample: int


def render(
    mesh: TexturedMesh, textures: Sequence[UInt8[Any, "_ _ 3"]] | None = None, **view: Any
) -> UInt8[Any, "size size 3"]:
    """The view that `look` takes of the mesh, with `textures` instead of its own if they are given.

    For one mesh in many colours, `look` once and `show` each.
    """
    if textures is not None:
        if len(textures) != (count := len(mesh.textures)):
            raise ValueError(f"{len(textures)} textures for a mesh that has {count}; give one image for each")
        mesh = mesh.with_layer(images=tuple(textures))
    return show(look(mesh, **view), mesh)


def look(
    mesh: TexturedMesh,
    azimuth: float | int = 30.0,
    elevation: float | int = 20.0,
    size: int = 512,
    up: Literal["y", "z"] = "y",
    supersample: int = 2,
) -> View:
    """A square view in perspective, for any colours. Each of its pixels is the mean of supersample² rays."""
    axes, eye = _camera(mesh.vertices, azimuth, elevation, up)
    seen = (mesh.vertices - eye) @ axes.T  # right, up, towards the viewer
    depths = -seen[:, 2]
    rays = size * supersample
    zoom = rays / 2 / np.tan(np.radians(FIELD_OF_VIEW / 2))
    screen = seen[:, :2] * [zoom, -zoom] / depths[:, None] + (rays - 1) / 2
    hits, points = _visible(screen, depths, mesh.faces, rays)

    normals = np.einsum("pkx,pk->px", corner_normals(mesh).take(points.faces, 0), points.barycentrics)
    towards = -np.einsum("pkx,pk->px", seen.take(mesh.faces.take(points.faces, 0), 0), points.barycentrics)
    light, gloss = _lighting(normals @ axes.T, towards, axes @ np.eye(3)["xyz".index(up)])
    return View(hits, points, light, gloss, size, supersample)


def show(view: View, mesh: TexturedMesh, tints: Float32[Any, "F 3 3"] | None = None) -> UInt8[Any, "_ _ 3"]:
    """The picture of a view in the colours of `mesh`, which must have the vertices and faces of the view.

    `tints`, at the corners of faces, multiply the colours in linear light.
    """
    size, n = view.size, view.supersample
    colors = LINEAR[_steps(surface_colors(mesh, view.points))]
    if tints is not None:
        colors = colors * np.einsum("pkc,pk->pc", tints[view.points.faces], view.points.barycentrics)
    picture = np.full(((size * n) ** 2, 3), LINEAR[round(BACKGROUND * STEPS)], np.float32)
    picture[view.rays] = colors * view.light[:, None] + view.gloss[:, None]
    rays = picture.reshape(size, n, size, n, 3)
    mean = sum((rays[:, i, :, j] for i, j in np.ndindex(n, n)), np.float32(0)) / np.float32(n * n)
    return ENCODED[_steps(mean)]


def _camera(
    vertices: Vertices, azimuth: float | int, elevation: float | int, up: str
) -> tuple[Float64[Any, "3 3"], Float64[Any, "3"]]:
    """The viewer's axes (right, up, towards the viewer; rows) and eye."""
    middle = (vertices.min(0) + vertices.max(0)) / 2
    radius = np.linalg.norm(vertices - middle, axis=1).max()
    a, e = np.radians([azimuth, elevation])
    right = np.array([np.cos(a), 0.0, -np.sin(a)])
    towards = np.array([np.cos(e) * np.sin(a), np.sin(e), np.cos(e) * np.cos(a)])
    axes = np.stack([right, np.cross(towards, right), towards])
    if up == "z":
        axes = np.stack([axes[:, 0], -axes[:, 2], axes[:, 1]], 1)
    distance = 1.02 * radius / np.sin(np.radians(FIELD_OF_VIEW / 2))
    return axes, middle + distance * axes[2]


def _visible(
    screen: Float64[Any, "V 2"], depths: Float64[Any, "V"], faces: Faces, rays: int
) -> tuple[Int[Any, "P"], SurfacePoints]:
    """The z-buffer: pixels where a face is visible, and the nearest point there.

    1/depth is linear on the screen. 31 bits of it and the face's index share one integer, so that the largest
    integer holds the nearest face (the last one of equally near faces).
    """
    nearness = 1 / depths
    low, high = nearness.min(), nearness.max()
    scaled = (nearness - low) / max(high - low, 1e-300) * (2**31 - 1)
    nearest = np.full(rays * rays, -1, np.int64)
    barycentrics = barycentric_planes(screen[faces])
    near = Planes(*((plane * scaled[faces].T).sum(0, keepdims=True) for plane in barycentrics))
    for inside in pixels_inside(screen[faces]):
        steps = near(*inside)[0].astype(np.int64)
        np.maximum.at(nearest, inside.rows * rays + inside.columns, steps << 32 | inside.triangles)
    pixels = np.flatnonzero(nearest >= 0)
    hits = nearest[pixels] & 0xFFFFFFFF
    rows, columns = np.divmod(pixels, rays)
    shares = barycentrics(hits, columns, rows) * nearness[faces.T[:, hits]]
    return pixels, SurfacePoints(hits, np.ascontiguousarray((shares / shares.sum(0)).T))


def corner_normals(mesh: TexturedMesh) -> Float64[Any, "F 3 3"]:
    """Area-weighted vertex normals, but the face's own normal at corners on a crease."""
    flat = face_normals(mesh.vertices, mesh.faces)
    areas = area_normals(mesh.vertices, mesh.faces)
    smooth = vertex_normals(mesh.faces, areas, len(mesh.vertices))[mesh.faces]
    creased = np.einsum("fkx,fx->fk", smooth, flat) < CREASE
    return np.where(creased[..., None], flat[:, None], smooth)


def _lighting(
    normals: Float64[Any, "P 3"], towards: Float64[Any, "P 3"], upward: Float64[Any, "3"]
) -> tuple[Float32[Any, "P"], Float32[Any, "P"]]:
    """Linear light from a soft lamp at the viewer's shoulder, the sky and all around; and a faint gloss."""
    normals, towards, key, sky = (x.astype(np.float32) for x in (normals, towards, KEY_LIGHT, upward))
    towards /= _lengths(towards)
    facing = dot(normals, towards)
    normals *= np.where(facing < 0, -1, 1)[:, None] / np.maximum(_lengths(normals), 1e-30)
    key /= np.linalg.norm(key)
    half = towards + key
    half /= _lengths(half)
    soft = np.clip((normals @ key + 0.25) / 1.25, 0, 1)  # reaches a little beyond 90°
    light = AMBIENT + SKY * (normals @ sky + 1) / 2 + KEY * soft
    gloss = SHINE * np.clip(dot(normals, half), 0, 1) ** 60
    return light.astype(np.float32), gloss.astype(np.float32)


def _lengths(vectors: Float32[Any, "P 3"]) -> Float32[Any, "P 1"]:
    return np.sqrt(dot(vectors, vectors))[:, None]  # 10 times as fast as linalg.norm


def contact_sheet(
    rows: Sequence[Sequence[UInt8[Any, "_ _ 3"]]], captions: Sequence[str] | None = None
) -> UInt8[Any, "_ _ 3"]:
    """Pictures centred in the cells of a grid, with one caption above each column."""
    columns = max(map(len, rows))
    if captions is not None and len(captions) != columns:
        raise ValueError(f"{len(captions)} captions for {columns} columns; give one for each")
    height, width = np.max([picture.shape[:2] for row in rows for picture in row], axis=0).tolist()
    letters = max(12, width // 20)
    top = MARGIN + (letters + MARGIN if captions else 0)
    lefts = [MARGIN + x * (width + MARGIN) for x in range(columns + 1)]
    tops = [top + y * (height + MARGIN) for y in range(len(rows) + 1)]
    sheet = Image.new("RGB", (lefts[-1], tops[-1]), (round(BACKGROUND * 255),) * 3)
    for y, row in zip(tops, rows, strict=False):
        for x, picture in zip(lefts, row, strict=False):
            corner = (x + (width - picture.shape[1]) // 2, y + (height - picture.shape[0]) // 2)
            sheet.paste(Image.fromarray(picture), corner)
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(letters)
    for x, caption in zip(lefts, captions or (), strict=False):
        place = (x + width / 2, MARGIN + letters / 2)
        pen.text(place, caption, fill=(60, 60, 60), font=font, anchor="mm")
    return np.array(sheet)


def _steps(colors: Float32[Any, "*N 3"]) -> Int[Any, "*N 3"]:
    return (np.clip(colors, 0, 1) * STEPS + 0.5).astype(np.int32)


LINEAR = linear(np.arange(STEPS + 1) / STEPS).astype(np.float32)
ENCODED = np.rint(srgb(np.arange(STEPS + 1) / STEPS) * 255).astype(np.uint8)
