"""The vase is a good asset: closed, unwrapped without overlap, and painted without seams."""

import time
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from flx.assets.asset import own_painting
from flx.assets.read import read_asset
from flx.assets.vase import vase, vase_asset
from flx.assets.write import write
from flx.config import Surface
from flx.geometry.atlas import atlas_texels
from flx.geometry.sampling import face_normals, texture_colors
from flx.training.run import Run
from flx.training.run_asset import keep, read_source
from flx.types import TexturedMesh

pytestmark = pytest.mark.slow


def exported_by_trimesh(mesh: TexturedMesh, path: Path) -> Path:
    """The vase as it used to be made: trimesh writes it, and it is read from there."""
    corners = np.concatenate([mesh.faces.reshape(-1, 1), mesh.corner_uvs.reshape(-1, 2)], 1)
    split, faces = np.unique(corners, axis=0, return_inverse=True)
    welded = split[:, 0].astype(np.int64)
    material = trimesh.visual.material.PBRMaterial(
        name="glaze",
        baseColorTexture=Image.fromarray(mesh.textures[0]),
        metallicFactor=0.0,
        roughnessFactor=0.35,
    )
    uv = np.stack([split[:, 1], 1 - split[:, 2]], 1)
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    normals = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).vertex_normals[welded]
    body = trimesh.Trimesh(
        mesh.vertices[welded], faces.reshape(-1, 3), vertex_normals=normals, visual=visual, process=False
    )
    scene = trimesh.Scene()
    scene.add_geometry(body, node_name="vase", geom_name="vase")
    scene.export(str(path), file_type="glb", include_normals=True)
    return path


@pytest.fixture(scope="module")
def mesh() -> TexturedMesh:
    return vase()


def half_edges(mesh: TexturedMesh) -> np.ndarray:
    return np.stack([mesh.faces, np.roll(mesh.faces, -1, 1)], -1).reshape(-1, 2)


def test_it_is_one_closed_oriented_sphere(mesh):
    edges = half_edges(mesh)
    assert len(np.unique(edges, axis=0)) == len(edges)  # no direction twice: oriented, manifold
    assert {tuple(e) for e in edges} == {tuple(e) for e in edges[:, ::-1]}  # closed
    assert len(mesh.vertices) - len(edges) // 2 + len(mesh.faces) == 2
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert solid.body_count == 1 and solid.volume > 0.1  # outward
    assert (np.linalg.norm(face_normals(mesh.vertices, mesh.faces), axis=1) > 0.99).all()


def test_it_stands_upright_about_one_high(mesh):
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    assert low[1] == 0 and high[1] == pytest.approx(1, abs=0.05)
    np.testing.assert_allclose((low + high)[[0, 2]], 0, atol=1e-9)


def test_its_charts_neither_overlap_nor_leave_the_texture_nor_mirror(mesh):
    assert mesh.corner_uvs.min() > 0 and mesh.corner_uvs.max() < 1
    edges = mesh.corner_uvs[:, 1:] - mesh.corner_uvs[:, :1]
    areas = -np.linalg.det(edges) / 2  # v runs down
    assert (areas > 0).all()
    height, width = mesh.textures[0].shape[:2]
    covered = len(atlas_texels(mesh, 0, height, width).texels) / (height * width)
    assert covered == pytest.approx(areas.sum(), rel=2e-3)
    assert covered > 0.4


def test_its_texels_are_spread_evenly(mesh):
    edges = mesh.corner_uvs[:, 1:] - mesh.corner_uvs[:, :1]
    in_texture = np.abs(np.linalg.det(edges)) / 2
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    on_surface = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    density = in_texture / on_surface
    typical = (np.abs(density / np.median(density) - 1) < 0.25) * on_surface
    assert typical.sum() > 0.9 * on_surface.sum()


def seam_edges(mesh: TexturedMesh) -> tuple[np.ndarray, np.ndarray]:
    """Both sides' UVs of the ends of each edge, where the two sides differ: E 2 2."""
    order = {tuple(edge): n for n, edge in enumerate(half_edges(mesh))}
    ends = np.stack([mesh.corner_uvs, np.roll(mesh.corner_uvs, -1, 1)], 2).reshape(-1, 2, 2)
    twins = np.array([order[b, a] for a, b in half_edges(mesh)])
    other = ends[twins][:, ::-1]
    seams = np.abs(ends - other).max((1, 2)) > 1e-6
    return ends[seams], other[seams]


def test_colours_run_on_across_uv_seams(mesh):
    one, two = seam_edges(mesh)
    assert len(one) > 200
    shares = np.array([0.2, 0.5, 0.8])[:, None, None]
    sides = [
        texture_colors(mesh.textures[0], (e[:, 0] * (1 - shares) + e[:, 1] * shares).reshape(-1, 2))
        for e in (one, two)
    ]
    across = np.abs(sides[0] - sides[1])
    elsewhere = np.abs(sides[0] - np.roll(sides[1], 40, 0)).mean()
    assert elsewhere > 0.1  # the seams are not plain
    # What is left is a texel's width at the rims of brush marks.
    assert np.median(across) < 0.02 and across.mean() < 0.15 * elsewhere


def test_its_pattern_has_many_colours(mesh):
    image = mesh.textures[0].astype(float) / 255
    atlas = atlas_texels(mesh, 0, *image.shape[:2])
    colors = image[atlas.covered]
    for channel in range(3):
        assert colors[:, channel].std() > 0.1
    for color in ((0.95, 0.92, 0.84), (0.2, 0.35, 0.68), (0.25, 0.5, 0.35), (0.85, 0.5, 0.18)):
        share = (np.abs(colors - color).max(1) < 0.15).mean()  # cream, cobalt, leaf, ochre to iron
        assert share > 0.01, color


def test_it_is_the_same_each_time_and_made_in_seconds(mesh):
    start = time.process_time()
    again = vase()
    assert time.process_time() - start < 5
    np.testing.assert_array_equal(again.textures[0], mesh.textures[0])


def test_the_file_holds_the_same_vase(mesh, tmp_path):
    write(asset := vase_asset(), own_painting(asset), tmp_path / "vase.glb")
    scene = trimesh.load_scene(tmp_path / "vase.glb")
    (body,) = scene.geometry.values()
    assert list(scene.geometry) == ["vase"] and body.visual.material.name == "glaze"
    np.testing.assert_array_equal(np.asarray(body.visual.material.baseColorTexture), mesh.textures[0])
    assert len(body.faces) == len(mesh.faces)
    np.testing.assert_allclose(body.vertices[body.faces], mesh.vertices[mesh.faces], atol=1e-6)
    uvs = body.visual.uv[body.faces] * [1, -1] + [0, 1]  # trimesh counts v from below
    np.testing.assert_allclose(uvs, mesh.corner_uvs, atol=1e-6)
    welded = trimesh.Trimesh(body.vertices, body.faces)
    welded.merge_vertices(merge_tex=True, merge_norm=True)
    assert welded.is_watertight


def test_it_is_the_asset_that_runs_have_known_bit_for_bit(mesh, tmp_path):
    """Prepared copies and runs are found by its digest, and their copy of it must read back the same."""
    old, new = read_asset(exported_by_trimesh(mesh, tmp_path / "old.glb")), vase_asset()
    assert new.digest == old.digest
    for name in ("positions", "uvs", "faces"):
        np.testing.assert_array_equal(getattr(new.parts[0], name), getattr(old.parts[0], name))
    np.testing.assert_allclose(new.parts[0].normals, old.parts[0].normals, atol=1e-7)
    materials = [asset.container.document["materials"] for asset in (old, new)]
    assert materials[0] == materials[1]
    surface, run = Surface(), Run(tmp_path / "run")
    assert read_source(surface).digest == keep(new, run, surface).digest == old.digest
    assert not list(tmp_path.glob("run/**/*.obj")) and list(tmp_path.glob("run/**/vase.glb"))
