"""Pictures of a textured mesh by a NumPy z-buffer: no GL library, no display.

The camera looks at the middle of the mesh from (azimuth, elevation) in degrees; azimuth 0 looks along −z
(y up, glTF) or along +y (z up), and grows counter-clockwise seen from above. It stands back until the sphere
about the mesh fits, so every view has the same scale. Light is added and pixels are averaged linearly, not
in sRGB. Both sides of a face are drawn.
"""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int, UInt8
from PIL import Image, ImageDraw, ImageFont

from flx.geometry.arrays import area_normals, sum_at
from flx.geometry.color import linear, srgb
from flx.geometry.raster import Planes, barycentric_planes, pixels_inside
from flx.geometry.sampling import face_normals, surface_colors
from flx.types import SurfacePoints, TexturedMesh

BACKGROUND = 0.94  # sRGB grey: white glaze stands out from it
FIELD_OF_VIEW = 25.0  # degrees
CREASE = 0.82  # cosine of the angle, 35°, beyond which a corner keeps its face's normal
KEY_LIGHT = np.array([-0.35, 0.5, 0.8])  # over the viewer's left shoulder: right, up, towards the viewer
AMBIENT, SKY, KEY, SHINE = (
    0.30,
    0.16,
    0.58,
    0.03,
)  # linear light; they add up to about 1 where it is brightest
STEPS = 4095  # of the tables between sRGB and linear light


class View(NamedTuple):
    """What does not change with a mesh's colours: where rays meet it, and how these points are lit."""

    rays: Int[Any, "P"]  # that meet the surface, of (size · supersample)²
    points: SurfacePoints
    light: Float32[Any, "P"]
    gloss: Float32[Any, "P"]
    size: int
    supersample: int


def render(
    mesh: TexturedMesh,
    textures: Sequence[UInt8[Any, "_ _ 3"]] | None = None,
    azimuth: float | int = 30.0,
    elevation: float | int = 20.0,
    size: int = 512,
    up: Literal["y", "z"] = "y",
    supersample: int = 2,
) -> UInt8[Any, "size size 3"]:
    """A square view in perspective; `textures`, where given, are shown instead of the mesh's own.

    Each pixel is the mean of supersample² rays. For many colours of one mesh, `look` once and `show` each.
    """
    if textures is not None:
        if len(textures) != len(mesh.textures):
            raise ValueError(
                f"{len(textures)} textures for a mesh that has {len(mesh.textures)}; give one image for each"
            )
        mesh = mesh.with_layer(images=tuple(textures))
    return show(look(mesh, azimuth, elevation, size, up, supersample), mesh)


def look(
    mesh: TexturedMesh,
    azimuth: float | int = 30.0,
    elevation: float | int = 20.0,
    size: int = 512,
    up: Literal["y", "z"] = "y",
    supersample: int = 2,
) -> View:
    """The geometry of a view, whatever the colours."""
    axes, eye = _camera(mesh.vertices, azimuth, elevation, up)
    seen = (mesh.vertices - eye) @ axes.T  # right, up, towards the viewer
    depths = -seen[:, 2]
    rays = size * supersample
    zoom = rays / 2 / np.tan(np.radians(FIELD_OF_VIEW / 2))
    screen = seen[:, :2] * [zoom, -zoom] / depths[:, None] + (rays - 1) / 2
    hits, points = _visible(screen, depths, mesh.faces, rays)

    normals = np.einsum("pkx,pk->px", _corner_normals(mesh).take(points.faces, 0), points.barycentrics)
    towards = -np.einsum("pkx,pk->px", seen.take(mesh.faces.take(points.faces, 0), 0), points.barycentrics)
    light, gloss = _lighting(normals @ axes.T, towards, axes @ np.eye(3)["xyz".index(up)])
    return View(hits, points, light, gloss, size, supersample)


def show(view: View, mesh: TexturedMesh) -> UInt8[Any, "_ _ 3"]:
    """The picture of a view in the colours of `mesh`, whose vertices and faces are those looked at."""
    size, n = view.size, view.supersample
    colors = LINEAR[_steps(surface_colors(mesh, view.points))]
    picture = np.full(((size * n) ** 2, 3), LINEAR[round(BACKGROUND * STEPS)], np.float32)
    picture[view.rays] = colors * view.light[:, None] + view.gloss[:, None]
    rays = picture.reshape(size, n, size, n, 3)
    mean = sum((rays[:, i, :, j] for i, j in np.ndindex(n, n)), np.float32(0)) / np.float32(n * n)
    return ENCODED[_steps(mean)]


def _camera(
    vertices: Float64[Any, "V 3"], azimuth: float | int, elevation: float | int, up: str
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
    screen: Float64[Any, "V 2"], depths: Float64[Any, "V"], faces: Int[Any, "F 3"], rays: int
) -> tuple[Int[Any, "P"], SurfacePoints]:
    """The z-buffer: pixels where a face is seen, and the nearest point there.

    1/depth is linear on the screen; 31 bits of it and the face share one integer, so that its maximum names
    the nearest face (the last of equally near ones).
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


def _corner_normals(mesh: TexturedMesh) -> Float64[Any, "F 3 3"]:
    """Area-weighted vertex normals, but the face's own at corners that sit on a crease."""
    areas = area_normals(mesh.vertices, mesh.faces)
    flat = face_normals(mesh.vertices, mesh.faces)
    smooth = sum_at(mesh.faces, areas, len(mesh.vertices))
    smooth /= np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-300)
    smooth = smooth[mesh.faces]
    creased = np.einsum("fkx,fx->fk", smooth, flat) < CREASE
    return np.where(creased[..., None], flat[:, None], smooth)


def _lighting(
    normals: Float64[Any, "P 3"], towards: Float64[Any, "P 3"], upward: Float64[Any, "3"]
) -> tuple[Float32[Any, "P"], Float32[Any, "P"]]:
    """Linear light from a soft lamp at the viewer's shoulder, the sky and everywhere; and a faint gloss."""
    normals, towards, key, sky = (x.astype(np.float32) for x in (normals, towards, KEY_LIGHT, upward))
    towards /= _lengths(towards)
    facing = np.einsum("px,px->p", normals, towards)
    normals *= np.where(facing < 0, -1, 1)[:, None] / np.maximum(_lengths(normals), 1e-30)
    key /= np.linalg.norm(key)
    half = towards + key
    half /= _lengths(half)
    soft = np.clip((normals @ key + 0.25) / 1.25, 0, 1)  # wraps a little round the edge
    light = AMBIENT + SKY * (normals @ sky + 1) / 2 + KEY * soft
    gloss = SHINE * np.clip(np.einsum("px,px->p", normals, half), 0, 1) ** 60
    return light.astype(np.float32), gloss.astype(np.float32)


def _lengths(vectors: Float32[Any, "P 3"]) -> Float32[Any, "P 1"]:
    return np.sqrt(np.einsum("px,px->p", vectors, vectors))[:, None]  # 10 times as fast as linalg.norm


def contact_sheet(
    rows: Sequence[Sequence[UInt8[Any, "_ _ 3"]]], captions: Sequence[str] | None = None, margin: int = 12
) -> UInt8[Any, "_ _ 3"]:
    """Pictures on a grid, each cell as large as the largest, with one caption above each column."""
    columns = max(map(len, rows))
    if captions is not None and len(captions) != columns:
        raise ValueError(f"{len(captions)} captions for {columns} columns; give one for each")
    height = max(picture.shape[0] for row in rows for picture in row)
    width = max(picture.shape[1] for row in rows for picture in row)
    letters = max(12, width // 20)
    top = margin + (letters + margin if captions else 0)
    grey = round(BACKGROUND * 255)
    sheet = Image.new(
        "RGB", (columns * (width + margin) + margin, len(rows) * (height + margin) + top), (grey,) * 3
    )
    for y, row in enumerate(rows):
        for x, picture in enumerate(row):
            corner = (
                margin + x * (width + margin) + (width - picture.shape[1]) // 2,
                top + y * (height + margin) + (height - picture.shape[0]) // 2,
            )
            sheet.paste(Image.fromarray(picture), corner)
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(letters)
    for x, caption in enumerate(captions or ()):
        middle = margin + x * (width + margin) + width / 2
        pen.text((middle, margin + letters / 2), caption, fill=(60, 60, 60), font=font, anchor="mm")
    return np.array(sheet)


def _steps(colors: Float32[Any, "*N 3"]) -> Int[Any, "*N 3"]:
    return (np.clip(colors, 0, 1) * STEPS + 0.5).astype(np.int32)


LINEAR = linear(np.arange(STEPS + 1) / STEPS).astype(np.float32)
ENCODED = np.rint(srgb(np.arange(STEPS + 1) / STEPS) * 255).astype(np.uint8)
