"""Do stripes follow the direction? A striped vase, and the orientations of the stripes of what a run paints.

python tests/reports/stripes.py make stripes.glb
python tests/reports/stripes.py measure runs/stripes_direction [--count N] [--picture FILE.jpg]

The stripes run around the vase: at right angles to the direction y. The first command also writes
stripes.json: a stroke that runs up the front, and one around the back. The second makes variations by the
run's own direction, turned, by the strokes, and without. It prints how far stripes are from the right angle
to the direction that was asked for, as measured by the structure tensor of their luminance on the surface.
"""

import argparse
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

import flx
from flx.assets.asset import own_painting
from flx.geometry.arrays import area_normals, cross, face_areas, sum_at
from flx.geometry.atlas import atlas_texels, paint
from flx.geometry.direction import as_vectors, carried, field_on
from flx.geometry.remesh.remesh import remesh
from flx.geometry.sampling import closest_points, face_normals, positions, surface_colors, transfer
from flx.geometry.tangent import tangent_frames
from flx.pipeline.canvas import shown, side_by_side
from flx.pipeline.direction import read_direction
from flx.types import SurfacePoints, TexturedMesh

WAVELENGTH = 0.17  # of the stripes, where the vase is about 1 high
SMOOTHED = 0.06  # half-width over which gradients are averaged
STROKES = Path("stripes.json")
WAYS: dict[str, dict[str, Any]] = {
    "own direction": {},
    "--rotate 90": {"rotate": 90.0},
    "--rotate 90 --guidance 2": {"rotate": 90.0, "guidance": 2.0},
    "--rotate 45 --guidance 2": {"rotate": 45.0, "guidance": 2.0},
    "--direction stripes.json --guidance 2": {"direction": str(STROKES), "guidance": 2.0},
    "--guidance 0": {"guidance": 0.0},
}


def make(path: Path) -> None:
    """The vase of the demo with stripes across its axis, a little wavy, in three colours."""
    asset = flx.vase()
    mesh, (size, _, _) = asset.mesh, asset.mesh.textures[0].shape
    atlas = atlas_texels(mesh, 0, size, size)
    x, y, z = positions(mesh.vertices, mesh.faces, atlas.points).T
    phase = y / WAVELENGTH + 0.05 * np.sin(9 * x + 4 * z) * np.cos(7 * z + 8 * y)
    light = (0.5 + 0.5 * np.tanh(4 * np.sin(2 * np.pi * phase)))[:, None]
    thin = np.exp(-((np.sin(2 * np.pi * phase) / 0.25) ** 2))[:, None] * 0.6
    color = light * [0.93, 0.90, 0.82] + (1 - light) * [0.10, 0.22, 0.50]
    color += thin * ([0.80, 0.35, 0.15] - color)
    image = paint(atlas, color.astype(np.float32))
    striped = flx.from_arrays(mesh.vertices, mesh.faces, mesh.corner_uvs, image, name="stripes")
    flx.save(striped, own_painting(striped), path)
    height, turn = np.linspace(0.2, 0.7, 30), np.linspace(-0.8, 0.8, 30)
    front = np.stack([0 * height, height, 0.4 + 0 * height], 1)
    back = np.stack([0.4 * np.sin(turn), 0.45 + 0 * turn, -0.4 * np.cos(turn)], 1)
    drawn = [positions(*mesh[:2], closest_points(places, *mesh[:2])).tolist() for places in (front, back)]
    STROKES.write_text(json.dumps({"strokes": [{"points": points} for points in drawn]}))


class Lines(NamedTuple):
    """How stripes lie at each vertex."""

    angles: np.ndarray  # degrees from the direction to the stripe, −90 to 90
    weights: np.ndarray  # area, 0 where there are no stripes or no direction


def lines(surface, mesh: TexturedMesh, vectors: np.ndarray) -> Lines:
    """Of a texture, at the vertices of a triangulation with the direction that was asked for there."""
    vertices, faces = surface
    corners = SurfacePoints(np.arange(3 * len(faces)) // 3, np.tile(np.eye(3) * 0.94 + 0.02, (len(faces), 1)))
    colors = surface_colors(mesh, transfer(corners, surface, mesh)).reshape(-1, 3, 3)
    light = colors @ [0.299, 0.587, 0.114]
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    normals, areas = face_normals(vertices, faces), face_areas(vertices, faces)
    edges = light[:, :1] * (c - b) + light[:, 1:2] * (a - c) + light[:, 2:] * (b - a)
    gradients = cross(normals, edges) / np.maximum(2 * areas, 1e-12)[:, None]
    tensors = np.einsum("fi,fj,f->fij", gradients, gradients, areas).reshape(-1, 9)
    field, masses = sum_at(faces, tensors, len(vertices)), sum_at(faces, areas[:, None], len(vertices))
    rings = round((SMOOTHED / np.sqrt(areas.mean())) ** 2)
    for _ in range(rings):
        field = sum_at(faces, field[faces].sum(1), len(vertices))
        masses = sum_at(faces, masses[faces].sum(1), len(vertices))
        field, masses = field / masses.max(), masses / masses.max()
    normals = area_normals(vertices, faces)
    normals = sum_at(faces, normals, len(vertices))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    across = np.linalg.eigh((field / masses).reshape(-1, 3, 3))
    strongest = across.eigenvectors[:, :, 2]
    along = cross(normals, np.ascontiguousarray(strongest))
    side = cross(normals, vectors)
    angles = np.degrees(np.arctan2((along * side).sum(1), (along * vectors).sum(1)))
    clear = across.eigenvalues[:, 2] > 0.1 * np.median(across.eigenvalues[:, 2])
    there = clear & (np.linalg.norm(vectors, axis=1) > 0.5)
    return Lines((angles + 90) % 180 - 90, there * sum_at(faces, areas[:, None], len(vertices))[:, 0])


def told(name: str, found: list[Lines]) -> str:
    """Mean orientation, and the share of the area that lies within 15 and 30 degrees of a right angle."""
    angles, weights = (np.concatenate(parts) for parts in zip(*found, strict=True))
    mean = np.degrees(np.angle(np.sum(weights * np.exp(2j * np.radians(angles))))) / 2 % 180
    off = 90 - np.abs(angles)
    histogram = np.histogram(off, [0, 15, 30, 45, 60, 75, 90], weights=weights)[0] / weights.sum()
    return f"| {name} | {mean:.0f}° | {' | '.join(f'{share:.2f}' for share in histogram)} |"


def measure(run: Path, picture: Path | None, count: int) -> None:
    generator = flx.load_generator(run)
    asset, home = generator.asset, generator.home.triangulation
    surface = remesh(asset.mesh.vertices, asset.mesh.faces, 8000, 99)
    own = carried(generator.direction, home, surface)
    bins = " | ".join(f"{low}–{low + 15}°" for low in range(0, 90, 15))
    print(f"| samples | mean | {bins} |\n{'|---' * 8}|")

    def vectors(rotate: float = 0.0, direction: str | None = None, **_: float) -> np.ndarray:
        there = own if direction is None else field_on(read_direction(direction, asset), surface)
        return as_vectors(there * np.exp(1j * np.radians(rotate)), surface, tangent_frames(surface))

    print(told("input", [lines(surface, asset.mesh, vectors())]))
    paintings = []
    for name, how in WAYS.items():
        made = list(
            flx.generate(generator, count, texture_size=512, controls=flx.Controls(invention=1.0, **how))
        )
        print(told(name, [lines(surface, shown(asset, p), vectors(**how)) for p in made]), flush=True)
        paintings.append(made[0])
    if picture:
        names = [name.replace(" --guidance 2", ", guidance 2").replace("--", "") for name in WAYS]
        image = Image.fromarray(side_by_side(asset, paintings, names, "y", 240))
        image.convert("RGB").save(picture, quality=85)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=["make", "measure"])
    parser.add_argument("path", type=Path)
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--count", type=int, default=2)
    options = parser.parse_args()
    if options.what == "make":
        make(options.path)
    else:
        measure(options.path, options.picture, options.count)
