"""A material of which all maps come from one height, and how well they still do so in another file."""

import json
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_erosion
from scipy.spatial import KDTree

from flx.assets.asset import Asset, Painting, Texture
from flx.assets.formats.glb import glb_bytes
from flx.assets.formats.gltf import Gltf, append, append_view, read_gltf
from flx.assets.formats.images import encode_png
from flx.assets.write import write
from flx.geometry.arrays import cross, face_areas
from flx.geometry.atlas import atlas_texels, paint
from flx.geometry.sampling import face_normals, positions, surface_colors
from flx.pipeline.instant import tangent_axes
from flx.types import Layer, SurfacePoints, TexturedMesh

STEEP = 1.0  # height of a bump for its radius
LOW, HIGH = np.array([0.25, 0.16, 0.10]), np.array([0.85, 0.75, 0.55])


def bumpy(asset: Asset, side: int, count: int, seed: int = 0) -> Asset:
    """The asset with round bumps at random places: lighter, smoother and steeper where they are high."""
    mesh, rng = asset.mesh, np.random.default_rng(seed)
    areas = face_areas(mesh.vertices, mesh.faces)
    on = SurfacePoints(rng.choice(len(areas), count, p=areas / areas.sum()), rng.dirichlet((1, 1, 1), count))
    seeds = KDTree(positions(mesh.vertices, mesh.faces, on))
    radii = np.sqrt(areas.sum() / count / np.pi) * rng.uniform(0.6, 1.1, count)

    def height(places: np.ndarray) -> np.ndarray:
        distances, nearest = seeds.query(places, 3)
        inside = np.maximum(1 - (distances / radii[nearest]) ** 2, 0)
        return (radii[nearest] * inside**2).max(1)

    shape = Layer((), np.zeros(len(mesh.faces), np.int64), mesh.corner_uvs)
    mesh = mesh._replace(maps={"base_color": shape, "normal": shape})
    atlas = atlas_texels(mesh, 0, side, side)
    points, step = atlas.points, 0.01 * radii.mean()
    places = positions(mesh.vertices, mesh.faces, points)
    slopes = []
    for axis in tangent_axes(mesh):
        there = step * axis[points.faces]
        slopes.append(STEEP * (height(places + there) - height(places - there)) / (2 * step))
    high = (height(places) / radii.max())[:, None]
    normals = np.stack([-slopes[0], -slopes[1], np.ones(len(places))], 1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    rough = np.concatenate([0 * high, 0.9 - 0.7 * high, 0.2 + 0.6 * high], 1)
    values = {
        "base_color": LOW + high * (HIGH - LOW),
        "normal": normals / 2 + 0.5,
        "metallic_roughness": rough,
    }
    maps = {slot: shape._replace(images=(paint(atlas, v.astype(np.float32)),)) for slot, v in values.items()}
    return asset._replace(
        mesh=mesh._replace(maps=maps), sources={slot: (Texture(slot, None, False),) for slot in maps}
    )


def write_bumpy(asset: Asset, path: Path) -> None:
    """As one GLB with three maps."""
    write(asset, Painting({"base_color": asset.mesh.textures}), path)
    plain = read_gltf(path)
    document, views = json.loads(json.dumps(plain.document)), list(plain.views)
    material = document["materials"][0]
    of = {"normal": (material, "normalTexture")}
    of["metallic_roughness"] = (material["pbrMetallicRoughness"], "metallicRoughnessTexture")
    for slot, (part, name) in of.items():
        view = append_view(document, views, encode_png(asset.mesh.maps[slot].images[0], None))
        number = append(document, "images", {"bufferView": view, "mimeType": "image/png"})
        part[name] = {"index": append(document, "textures", {"source": number})}
    material["pbrMetallicRoughness"] |= {"metallicFactor": 1.0, "roughnessFactor": 1.0}
    path.write_bytes(glb_bytes(Gltf(document, tuple(views))))


def registration(mesh: TexturedMesh) -> dict[str, float]:
    """1 where maps are in register, 0 where they have nothing to do with each other.

    "normal": the correlation of the gradient of the luminance with how far normals lean, as vectors on the
    surface; "roughness": that of luminance and smoothness.
    """
    image = mesh.textures[0]
    atlas = atlas_texels(mesh, 0, *image.shape[:2])
    inner = binary_erosion(atlas.covered, iterations=2).ravel()[atlas.texels]
    points = SurfacePoints(*(part[inner] for part in atlas.points))
    light = image.astype(float) / 255 @ [0.299, 0.587, 0.114]
    down, right = (g.ravel()[atlas.texels][inner] for g in np.gradient(light))
    vertices, faces = mesh.vertices, mesh.faces
    corners, normals = vertices[faces], face_normals(vertices, faces)
    opposite = np.roll(corners, 1, axis=1) - np.roll(corners, -1, axis=1)
    hats = np.stack([cross(normals, np.ascontiguousarray(opposite[:, k])) for k in range(3)], 1)
    hats /= np.maximum(2 * face_areas(vertices, faces), 1e-12)[:, None, None]
    of_u, of_v = np.einsum("fku,fkx->ufx", mesh.corner_uvs, hats)
    height, width = image.shape[:2]
    gradients = (right * width)[:, None] * of_u[points.faces] + (down * height)[:, None] * of_v[points.faces]
    x, y = (2 * surface_colors(mesh, points, "normal")[:, :2] - 1).T
    axes = tangent_axes(mesh)
    leans = x[:, None] * axes[0][points.faces] + y[:, None] * axes[1][points.faces]
    along = -(gradients * leans).sum() / np.sqrt((gradients**2).sum() * (leans**2).sum())
    smooth = 1 - surface_colors(mesh, points, "metallic_roughness")[:, 1]
    alike = np.corrcoef(smooth, light.ravel()[atlas.texels][inner])[0, 1]
    return {"normal": float(along), "roughness": float(alike)}
