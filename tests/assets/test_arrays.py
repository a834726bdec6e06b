"""Laws of assets from arrays: the same as from a file, and what is wrong is said in the caller's words."""

import numpy as np
import pytest
import trimesh
from helpers.surfaces import icosphere, square_grid
from PIL import Image

from flx.assets.arrays import from_arrays, from_trimesh, sheet_asset, to_trimesh
from flx.assets.asset import Asset, Painting, own_painting
from flx.assets.read import read_asset
from flx.assets.write import write
from flx.geometry.sampling import surface_colors
from flx.types import SurfacePoints

NAN = float("nan")


def picture(channels: int = 3, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (8, 12, channels)).astype(np.uint8)


def grid() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    vertices, faces = square_grid(4)
    return vertices, faces, vertices[:, :2] * [1, -1] + [0, 1]


def seen(asset: Asset) -> np.ndarray:
    """Colours at three places of every face, and where these are."""
    count = len(asset.mesh.faces)
    shares = np.tile(np.eye(3) * 0.7 + 0.1, (count, 1))
    points = SurfacePoints(np.repeat(np.arange(count), 3), shares)
    places = np.einsum("pkx,pk->px", asset.mesh.vertices[asset.mesh.faces[points.faces]], shares)
    rows = np.concatenate([places, surface_colors(asset.mesh, points)], 1)
    return rows[np.lexsort(np.round(rows[:, :3], 6).T)]


@pytest.mark.parametrize("format", ["glb", "obj"])
def test_an_asset_of_arrays_is_written_and_read_like_any_other(tmp_path, format):
    vertices, faces, uvs = grid()
    asset = from_arrays(vertices, faces, uvs, picture(), name="tile")
    assert (asset.report.vertices, asset.report.faces, asset.report.format) == (16, 18, "arrays")
    np.testing.assert_array_equal(asset.mesh.textures[0], picture())
    np.testing.assert_array_equal(asset.mesh.corner_uvs, uvs[faces])
    write(asset, own_painting(asset), tmp_path / f"out.{format}")
    again = read_asset(tmp_path / f"out.{format}")
    assert np.ptp(seen(again)[:, 3:]) > 0.5
    np.testing.assert_allclose(seen(again), seen(asset), atol=1e-5)
    write(asset, Painting({"base_color": [picture(seed=1)]}), tmp_path / f"new.{format}")
    np.testing.assert_array_equal(read_asset(tmp_path / f"new.{format}").mesh.textures[0], picture(seed=1))


@pytest.mark.parametrize("format", ["glb", "obj", "ply"])
def test_vertex_colours_of_arrays_come_back_from_every_format(tmp_path, format):
    vertices, faces = icosphere(1)
    colors = np.random.default_rng(0).integers(0, 256, (42, 3)).astype(np.uint8)
    asset = from_arrays(vertices, faces, colors=colors)
    np.testing.assert_array_equal(np.rint(asset.mesh.corner_colors * 255), colors[faces])
    write(asset, own_painting(asset), tmp_path / f"out.{format}")
    np.testing.assert_allclose(seen(read_asset(tmp_path / f"out.{format}")), seen(asset), atol=1e-6)


def test_lists_floats_and_corner_coordinates_mean_the_same():
    vertices, faces, uvs = grid()
    asset = from_arrays(vertices, faces, uvs, picture())
    listed = from_arrays(vertices.tolist(), faces.tolist(), uvs.tolist(), picture() / 255)
    corners = from_arrays(vertices, faces, uvs[faces], picture())
    assert asset.digest == listed.digest == corners.digest
    cut = uvs[faces].copy()
    cut[0] += 1  # a seam: the vertices of one face are doubled
    split = from_arrays(vertices, faces, cut, picture())
    assert split.report.vertices_read == 19 and split.report.vertices == 16
    np.testing.assert_array_equal(split.mesh.corner_uvs, cut)


def test_alpha_of_an_image_goes_out_again(tmp_path):
    vertices, faces, uvs = grid()
    asset = from_arrays(vertices, faces, uvs, picture(4))
    np.testing.assert_array_equal(asset.textures[0].alpha, picture(4)[..., 3])
    assert asset.paints[0].alpha_mode == "BLEND"
    write(asset, own_painting(asset), tmp_path / "out.glb")
    np.testing.assert_array_equal(read_asset(tmp_path / "out.glb").textures[0].alpha, picture(4)[..., 3])


def test_arrays_are_repaired_and_reported_like_a_file():
    vertices, faces, uvs = grid()
    twice = np.concatenate([vertices, vertices])  # every face has vertices of its own kind: they are welded
    faces = np.concatenate([faces[:9], faces[9:] + 16, [[3, 3, 2]]])
    asset = from_arrays(twice, faces, np.concatenate([uvs, uvs]), picture())
    assert asset.report.welded_vertices > 0 and asset.report.degenerate_faces == 1
    assert asset.report.faces == 18 and asset.report.components == 1


TRIANGLE = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
WHITE = [[1, 1, 1]] * 3
UVS = [[0, 0], [1, 0], [0, 1]]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"vertices": [], "faces": []}, "vertices has shape .0.; give .N, 3."),
        ({"faces": np.zeros((0, 3), int)}, "3 vertices and 0 faces; give at least one triangle"),
        ({"faces": []}, "3 vertices and 0 faces; give at least one triangle"),
        ({"vertices": [[0, 0, 0], [1, NAN, 0], [0, 1, 0]]}, r"vertices.1. is .1.0, nan, 0.0.; give finite"),
        ({"vertices": [[0, 0], [1, 0], [0, 1]]}, r"vertices has shape .3, 2.; give .N, 3."),
        ({"vertices": [[0, 0, 0], [1, 0], [0, 1, 0]]}, "vertices is not an array of numbers .*give .N, 3."),
        ({"vertices": "abc"}, "vertices is not an array of numbers"),
        ({"faces": [[0, 1, 3]]}, r"faces.0. is .0, 1, 3., but there are 3 vertices, counted from 0"),
        ({"faces": [[0, 1, 2], [0, -1, 2]]}, r"faces.1. is .0, -1, 2., but there are 3 vertices"),
        ({"faces": [[0, 1, 1.5]]}, r"faces.0. is .0.0, 1.0, 1.5.; give indices of vertices"),
        ({"faces": [[0, 1, 2, 0]]}, r"faces has shape .1, 4.; give .N, 3."),
        ({"colors": WHITE[:2]}, r"colors has shape .2, 3.; give .3, 3 or 4."),
        ({"colors": [[0, 0, 300]] * 3}, "colors has the value 300; give uint8, or numbers from 0 to 1"),
        ({"colors": [[0, 0, NAN]] * 3}, "colors has the value nan; give uint8, or numbers from 0 to 1"),
        ({"colors": None}, "give an image together with uvs, or colors"),
        ({"uvs": UVS}, "give an image together with uvs, or colors"),
        ({"image": picture()}, "give an image together with uvs, or colors"),
        ({"uvs": UVS, "image": picture()[..., 0]}, r"image has shape .8, 12.; give .N, N, 3 or 4."),
        ({"uvs": UVS, "image": picture()[..., :2]}, r"image has shape .8, 12, 2.; give .N, N, 3 or 4."),
        ({"uvs": UVS, "image": picture()[:0]}, r"image has shape .0, 12, 3.; give at least one pixel"),
        ({"uvs": UVS[:2], "image": picture()}, r"uvs has shape .2, 2.; give .3, 2."),
        ({"uvs": [UVS, UVS], "image": picture()}, r"uvs has shape .2, 3, 2.; give .1, 3, 2."),
        ({"uvs": [[0, 0], [NAN, 0], [0, 1]], "image": picture()}, r"uvs.1. is .nan, 0.0.; give finite"),
        ({"vertices": [[0, 0, 0]] * 3}, "mesh: no triangles: of 1, 1 have a corner twice"),
    ],
)
def test_what_cannot_be_used_is_said_in_the_callers_words(arguments, words):
    given = {"vertices": TRIANGLE, "faces": [[0, 1, 2]], "colors": WHITE}
    from_arrays(**given)
    with pytest.raises(ValueError, match=words) as refusal:
        from_arrays(**{**given, **arguments})
    assert "\n" not in str(refusal.value)


# --- trimesh


@pytest.mark.parametrize("kind", ["pbr", "simple", "vertex", "face"])
def test_a_trimesh_keeps_its_colours_there_and_back(kind):
    vertices, faces, uvs = grid()
    colors = np.random.default_rng(0).integers(0, 256, (16, 4)).astype(np.uint8)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    up = uvs * [1, -1] + [0, 1]
    image = Image.fromarray(picture())
    if kind == "pbr":
        material = trimesh.visual.material.PBRMaterial(baseColorTexture=image)
        mesh.visual = trimesh.visual.TextureVisuals(uv=up, material=material)
    elif kind == "simple":
        mesh.visual = trimesh.visual.TextureVisuals(uv=up, image=image)
    elif kind == "vertex":
        mesh.visual.vertex_colors = colors
    else:
        mesh.visual.face_colors = np.repeat(colors, 2, axis=0)[:18]
    asset = from_trimesh(mesh)
    if kind in ("pbr", "simple"):
        np.testing.assert_allclose(seen(asset), seen(from_arrays(vertices, faces, uvs, picture())), atol=1e-6)
    elif kind == "vertex":
        np.testing.assert_allclose(asset.mesh.corner_colors * 255, colors[faces][..., :3], atol=1e-4)
    else:
        expected = np.repeat(np.repeat(colors, 2, axis=0)[:18, None, :3], 3, 1)
        np.testing.assert_allclose(asset.mesh.corner_colors * 255, expected, atol=1e-4)
    back = to_trimesh(asset)
    np.testing.assert_allclose(seen(from_trimesh(back)), seen(asset), atol=1e-6)
    if kind == "pbr":
        np.testing.assert_allclose(back.visual.uv, up, atol=1e-12)
        new = to_trimesh(asset, Painting({"base_color": [picture(seed=2)]}))
        np.testing.assert_array_equal(np.asarray(new.visual.material.baseColorTexture), picture(seed=2))
    elif kind == "vertex":
        dark = to_trimesh(asset, Painting({}, np.zeros((16, 3), np.float32)))
        assert (dark.visual.vertex_colors == [0, 0, 0, 255]).all()


def test_what_a_trimesh_lacks_is_named():
    vertices, faces, uvs = grid()
    with pytest.raises(ValueError, match="the mesh has no colours; give it a texture, or vertex colours"):
        from_trimesh(trimesh.Trimesh(vertices, faces, process=False))
    visual = trimesh.visual.TextureVisuals(uv=uvs, material=trimesh.visual.material.PBRMaterial())
    bare = trimesh.Trimesh(vertices, faces, process=False, visual=visual)
    with pytest.raises(ValueError, match="has no image or no uv; give both"):
        from_trimesh(bare)


# --- the sheet


def test_a_sheet_is_what_an_obj_of_it_would_be(tmp_path):
    Image.fromarray(picture()).save(tmp_path / "p.png")
    corners = [(0, 0), (1, 0), (1, 1), (0, 1)]
    lines = [f"v {x * 12 / 8} {y} 0\nvt {x} {y}\n" for x, y in corners]
    (tmp_path / "p.obj").write_text("".join(lines) + "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n")
    sheet = sheet_asset(tmp_path / "p.png")
    assert sheet.digest == read_asset(tmp_path / "p.obj", tmp_path / "p.png").digest
    write(sheet, own_painting(sheet), tmp_path / "out.glb")
    assert read_asset(tmp_path / "out.glb").digest == sheet.digest
    (tmp_path / "bad.png").write_bytes(b"nothing")
    for name, words in (("bad.png", "is of no known kind"), ("gone.png", "does not exist; put it there")):
        with pytest.raises(ValueError, match=words):
            sheet_asset(tmp_path / name)


def test_faces_that_are_wound_against_each_other_are_told():
    vertices, faces = icosphere(2)
    turned = faces.copy()
    turned[::7] = turned[::7, ::-1]
    with pytest.warns(UserWarning, match=r"wound against each other.*fix_winding"):
        from_arrays(vertices, turned, colors=np.full((len(vertices), 3), 0.5))
