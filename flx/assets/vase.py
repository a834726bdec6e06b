"""A glazed vase with blossoms, made from formulas: an asset to try everything on without a download.

The height is about 1, the axis is y, the foot stands on y = 0. The surface is closed (χ = 2): outside, lip, a
well narrower than the outside (it is hardly seen, so it gets fewer vertices), its floor, foot. A texel's
colour depends only on its place in space, so the seams between the five charts do not show. The pattern
covers everything at one scale, 2 to 12 % of the height; no stroke is thinner than about 1 %.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import igl
import numpy as np
from jaxtyping import Float32, Float64
from scipy.interpolate import BSpline
from scipy.ndimage import map_coordinates
from scipy.spatial import KDTree

from flx.assets.assemble import assemble
from flx.assets.asset import Asset
from flx.assets.formats.glb import build_gltf
from flx.assets.formats.images import encode_png
from flx.assets.formats.obj import split_corners
from flx.assets.formats.parts import Paint, Part
from flx.assets.formats.readers import gltf_contents
from flx.geometry.arrays import Rng, face_areas
from flx.geometry.atlas import atlas_texels, paint
from flx.geometry.sampling import Places, face_normals, positions
from flx.types import Faces, Layer, SurfacePoints, TexturedMesh, Vertices

TEXTURE = 1024  # texels along each side
SPACING = 0.02  # of vertices along the profile and around the belly
SEED = 7
EDGE = 0.006  # width of a brush mark's edge: not quite three texels
# Control points (radius, height) of a quadratic B-spline, from the middle of the foot's underside to the
# middle of the well's floor.
# fmt: off
PROFILE = np.array([
    (0, 0.025), (0.06, 0.025), (0.115, 0.025), (0.13, 0.0), (0.16, 0.0), (0.165, 0.03), (0.15, 0.06),  # foot
    (0.20, 0.15), (0.305, 0.30), (0.35, 0.50), (0.31, 0.69), (0.17, 0.78),  # body
    (0.095, 0.85), (0.105, 0.94), (0.165, 0.985), (0.185, 1.015), (0.15, 1.03),  # neck and lip
    (0.10, 0.98), (0.055, 0.92), (0.05, 0.84), (0.09, 0.76), (0.12, 0.66), (0.12, 0.55),
    (0.08, 0.50), (0, 0.50),
])
# fmt: on

CREAM, CELADON = np.array([0.945, 0.915, 0.835]), np.array([0.80, 0.875, 0.815])
COBALT, SKY_BLUE = np.array([0.085, 0.19, 0.52]), np.array([0.33, 0.52, 0.79])
LEAF, MOSS = np.array([0.13, 0.42, 0.36]), np.array([0.42, 0.58, 0.30])
OCHRE, IRON = np.array([0.90, 0.66, 0.20]), np.array([0.74, 0.27, 0.17])


def vase() -> TexturedMesh:
    """The vase with its texture, the same each time."""
    vertices, faces, corner_uvs = _lathe()
    layer = Layer((), np.zeros(len(faces), np.int64), corner_uvs)
    no_colors = np.zeros((len(faces), 3, 3), np.float32)
    mesh = TexturedMesh(vertices, faces, {"base_color": layer}, no_colors)
    atlas = atlas_texels(mesh, 0, TEXTURE, TEXTURE)
    places = positions(vertices, faces, atlas.points)
    normals = positions(igl.per_vertex_normals(vertices, faces), faces, atlas.points)  # continuous
    return mesh.with_layer(images=(paint(atlas, _glaze(mesh, places, normals)),))


def vase_asset() -> Asset:
    """The vase as a GLB holds it: one glazed PBR material, vertices split along UV seams.

    Example:
        flx.show(flx.vase())
    """
    mesh = vase()
    rows, uvs, faces = split_corners(mesh.faces, mesh.corner_uvs)
    by_angle = igl.PER_VERTEX_NORMALS_WEIGHTING_TYPE_ANGLE
    normals = np.asarray(igl.per_vertex_normals(mesh.vertices, mesh.faces, by_angle))[rows]
    part = Part("vase", 0, mesh.vertices[rows], normals, uvs, None, faces)
    glaze = Paint("glaze", {"base_color": 0}, (1.0, 1.0, 1.0))
    pngs = {0: encode_png(mesh.textures[0], None)}
    file = build_gltf("vase", [part], [glaze], {"base_color": pngs})
    file.document["materials"][0]["doubleSided"] = False  # it is closed
    file.document["materials"][0]["pbrMetallicRoughness"]["roughnessFactor"] = 0.35
    return assemble(Path("vase"), gltf_contents(file), format="GLB")


# --- the shape

Uvs = Float64[Any, "F 3 2"]


def _profile() -> tuple[Float64[Any, "M 2"], Float64[Any, "M"]]:
    """(radius, height) at equal steps of the profile, and the length so far."""
    count = len(PROFILE)
    knots = np.concatenate([[0, 0], np.linspace(0, 1, count - 1), [1, 1]])
    dense = BSpline(knots, PROFILE, 2)(np.linspace(0, 1, 4001))
    lengths = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(dense, axis=0), axis=1))])
    steps = np.linspace(0, lengths[-1], round(lengths[-1] / SPACING) + 1)
    profile = np.stack([np.interp(steps, lengths, dense[:, k]) for k in range(2)], 1)
    profile[[0, -1], 0] = 0
    profile[:, 1] -= profile[:, 1].min()
    return profile, steps


def _lathe() -> tuple[Vertices, Faces, Uvs]:
    """The surface of revolution: vertices, faces and the UVs of their corners."""
    profile, _ = _profile()
    around = 4 * round(2 * np.pi * profile[:, 0].max() / SPACING / 4)
    inner = len(profile) - 2  # rings of vertices between the two poles
    angles = 2 * np.pi * np.arange(around) / around
    radii, heights = profile[1:-1].T[..., None]
    axes = np.broadcast_arrays(radii * np.sin(angles), heights, radii * np.cos(angles))
    poles = np.array([[0, profile[0, 1], 0], [0, profile[-1, 1], 0]])
    vertices = np.concatenate([np.stack(axes, -1).reshape(-1, 3), poles])

    # Corners as (step of the profile, step around), the latter up to `around`: a chart's far edge.
    i, j = np.meshgrid(np.arange(inner - 1) + 1, np.arange(around), indexing="ij")
    quads = [np.stack([a, b], -1).reshape(-1, 2) for a, b in ((i, j), (i, j + 1), (i + 1, j + 1), (i + 1, j))]
    fan = np.arange(around)
    at = lambda ring, turns: np.stack([np.full(around, ring), turns], -1)  # noqa: E731
    triangles = [(quads[0], quads[1], quads[2]), (quads[0], quads[2], quads[3])]
    triangles += [(at(0, fan), at(1, fan + 1), at(1, fan))]
    triangles += [(at(inner + 1, fan), at(inner, fan), at(inner, fan + 1))]
    corners = np.concatenate([np.stack(triangle, 1) for triangle in triangles])
    step, turn = corners[..., 0], corners[..., 1]  # of each face's corners
    faces = (step - 1) * around + turn % around
    faces = np.where(step == 0, len(vertices) - 2, np.where(step == inner + 1, len(vertices) - 1, faces))
    return vertices, faces, _unwrap(step, turn, around)


def _unwrap(step: Faces, turn: Faces, around: int) -> Uvs:
    """Five charts, none mirrored: two halves of the outside, the well, the foot, the well's floor.

    The sides keep areas: x = angle · radius, y = length along the profile. Foot and floor are discs.
    """
    profile, lengths = _profile()
    foot = np.flatnonzero(profile[:, 1] < 0.012)[-1]  # the outer rim of the foot
    lip = profile[:, 1].argmax()
    floor = len(profile) - 1 - round(0.10 / SPACING)
    middle = step.min(1)  # of the face's row
    half = 2 * turn.min(1) // around
    radius, length, angle = profile[step, 0], lengths[step], 2 * np.pi * turn / around
    strip = lambda centre, top: np.stack([(angle - centre) * radius, top - length], -1)  # noqa: E731
    disc = lambda distance: distance[..., None] * np.stack([np.sin(angle), np.cos(angle)], -1)  # noqa: E731
    charts = [
        ((middle >= foot) & (middle < lip) & (half == 0), strip(np.pi / 2, lengths[lip])),
        ((middle >= foot) & (middle < lip) & (half == 1), strip(3 * np.pi / 2, lengths[lip])),
        ((middle >= lip) & (middle < floor), strip(np.pi, lengths[floor])),
        (middle < foot, disc(length) * [1, -1]),
        (middle >= floor, disc(lengths[-1] - length)),
    ]
    return _pack(charts)


def _pack(charts: list[tuple[Any, Uvs]]) -> Uvs:
    """The first two charts side by side, the others in a row below, all at one scale inside [0, 1]."""
    gutter = 0.03
    uvs = np.empty_like(charts[0][1])
    below, right = 0.0, 0.0
    for row in (charts[:2], charts[2:]):
        x, y = gutter, below + gutter
        for chosen, chart in row:
            low, high = chart[chosen].min((0, 1)), chart[chosen].max((0, 1))
            uvs[chosen] = chart[chosen] - low + [x, y]
            x += high[0] - low[0] + gutter
            below, right = max(below, y + high[1] - low[1]), max(right, x)
    return uvs / max(below + gutter, right)


# --- the painting


class Motif(NamedTuple):
    """A kind of brush mark and how densely it is set."""

    kind: str
    reach: float  # greatest distance from its middle that it paints
    apart: float  # the radius about its middle that stays free
    tries: int  # how many places are tried; few make it sparse
    palette: tuple[Float64[Any, "3"], Float64[Any, "3"]]


# Large ones first; each later one fills gaps between the earlier.
MOTIFS = (
    Motif("blossom", 0.062, 0.064, 240, (COBALT, SKY_BLUE)),
    Motif("blossom", 0.050, 0.053, 160, (IRON, OCHRE)),
    Motif("blossom", 0.047, 0.048, 500, (SKY_BLUE, COBALT)),
    Motif("leaf", 0.044, 0.033, 1000, (LEAF, MOSS)),
    Motif("blossom", 0.031, 0.032, 700, (OCHRE, IRON)),
    Motif("leaf", 0.031, 0.024, 3000, (LEAF, COBALT)),
    Motif("dot", 0.016, 0.018, 3000, (COBALT, SKY_BLUE)),
    Motif("dot", 0.011, 0.013, 4000, (IRON, OCHRE)),
)


def _glaze(mesh: TexturedMesh, places: Places, normals: Places) -> Float32[Any, "P 3"]:
    """Colours at places of the surface: cream and celadon glaze, faint crackle, and the motifs on it."""
    rng = np.random.default_rng(SEED)
    clouds = _noise(places, 0.22, rng)
    colors = CREAM + (CELADON - CREAM) * np.clip(0.5 + 0.9 * clouds, 0, 1)[:, None]
    cells = KDTree(rng.uniform([-0.4, -0.05, -0.4], [0.4, 1.1, 0.4], (4000, 3)))
    near, far = cells.query(places, 2)[0].T
    colors *= 1 - 0.07 * np.exp(-(((far - near) / 0.007) ** 2))[:, None]
    washes = 0.75 + 0.5 * _noise(places, 0.03, rng)  # how thickly the brush laid the colour
    tree = KDTree(places)
    for motif, centre, normal in _scatter(mesh, rng):
        touched = np.array(tree.query_ball_point(centre, motif.reach + EDGE), np.int64)
        fade = np.clip(2 * normals[touched] @ normal + 0.4, 0, 1)  # round the lip, not through the wall
        touched, fade = touched[fade > 0], fade[fade > 0]
        if len(touched):
            full = np.clip(0.95 * washes[touched] + 0.2, 0.55, 1)
            for inside, color, strength in _strokes(motif, places[touched] - centre, normal, full, rng):
                cover = np.clip(inside / (EDGE / motif.reach) + 0.5, 0, 1) * strength * fade
                colors[touched] += cover[:, None] * (color - colors[touched])
    return np.clip(colors, 0, 1).astype(np.float32)


def _scatter(mesh: TexturedMesh, rng: Rng) -> list[tuple[Motif, Any, Any]]:
    """Motifs dropped one after another where they fit: places uniform by area, none overlapping."""
    areas = face_areas(mesh.vertices, mesh.faces)
    flat = face_normals(mesh.vertices, mesh.faces)
    taken, facing, radii, placed = np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), []
    for motif in MOTIFS:
        hits = rng.choice(len(areas), motif.tries, p=areas / areas.sum())
        corners = rng.dirichlet((1.0, 1.0, 1.0), motif.tries)
        middles = positions(mesh.vertices, mesh.faces, SurfacePoints(hits, corners))
        for middle, normal in zip(middles, flat[hits], strict=True):
            near = np.square(taken - middle).sum(1) < (radii + motif.apart) ** 2
            if (near & (facing @ normal > -0.3)).any():  # the far side of a wall does not compete
                continue
            taken, facing = np.concatenate([taken, middle[None]]), np.concatenate([facing, normal[None]])
            radii = np.append(radii, motif.apart)
            placed.append((motif, middle, normal))
    return placed


def _strokes(
    motif: Motif, offsets: Float64[Any, "N 3"], normal: Float64[Any, "3"], full: Any, rng: Rng
) -> Iterator[tuple[Any, Any, Any]]:
    """A motif's strokes, turned at random: how far inside each the `offsets` are, its colour and strength.

    Distances are those in space, directions those in the tangent plane, so a motif bends with the surface.
    """
    across = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    across /= np.linalg.norm(across)
    plane = offsets @ np.stack([across, np.cross(normal, across)], 1)
    reach = np.linalg.norm(offsets, axis=1) / motif.reach  # 0 in the middle, 1 at the rim
    angle = np.arctan2(plane[:, 1], plane[:, 0]) + rng.uniform(0, 2 * np.pi)
    x, y = reach * np.cos(angle), reach * np.sin(angle)
    outer, accent = motif.palette
    body = outer + (accent - outer) * rng.uniform(0, 0.45)
    if motif.kind == "blossom":
        petals = int(rng.integers(5, 8)) if motif.reach > 0.06 else 5
        rim = 0.62 + 0.34 * np.abs(np.cos(petals * angle / 2)) ** 0.8
        outward = np.clip((reach / rim - 0.25) / 0.75, 0, 1)[:, None] ** 1.5
        yield (rim - reach, accent + (body - accent) * outward, full)
        yield (0.40 - reach, CREAM, 0.92)
        heart = OCHRE if outer is COBALT else IRON if outer is SKY_BLUE else COBALT
        yield (0.25 - reach, heart, 0.95)
    elif motif.kind == "leaf":
        side = y - 0.22 * (x * x - 0.4)  # of the bent midrib
        width = 0.46 * (1 - x * x) * (1.12 - 0.35 * x)
        shade = np.clip(side / 0.8 + 0.3, 0, 1)[:, None]
        yield (width - np.abs(side), body + (accent - body) * shade, full)
        if motif.reach > 0.035:
            yield (0.075 * (0.9 - x) - np.abs(side), CREAM, 0.5)
    else:
        yield (0.92 - reach, body, full)


def _noise(places: Places, size: float, rng: Rng) -> Float64[Any, "P"]:
    """Smooth noise in space, about ±½, of blobs of this size."""
    grid = rng.uniform(-1, 1, (24, 24, 24))
    return map_coordinates(grid, places.T / size, order=2, mode="grid-wrap", prefilter=False)
