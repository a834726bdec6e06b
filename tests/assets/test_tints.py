"""Laws of factors: pictures show a texture times its factor in linear light; what is written keeps both."""

from pathlib import Path

import numpy as np
from helpers.files import MTL, OBJ, at, document, glb, gltf, obj, set_

from flx.assets.asset import own_painting
from flx.assets.read import read_asset
from flx.assets.tints import corner_tints, tinted, tints, tints_in_words
from flx.geometry import render
from flx.geometry.color import linear
from flx.pipeline.canvas import side_by_side

FACTOR = [0.5, 0.25, 1.0, 1.0]


def test_a_texture_is_shown_times_its_factor_in_linear_light(tmp_path):
    plain = read_asset(gltf(len)(tmp_path))
    asset = read_asset(at("materials", 0, "pbrMetallicRoughness", "baseColorFactor", to=FACTOR)(tmp_path))
    assert not tints(plain) and tinted(plain, plain.mesh).textures[0] is plain.mesh.textures[0]
    mesh = tinted(asset, asset.mesh)
    shown = mesh.textures[mesh.face_textures[0]]
    light = linear(asset.mesh.textures[0] / 255) * FACTOR[:3]
    np.testing.assert_allclose(linear(shown / 255), light, atol=0.006)
    assert np.abs(shown.astype(int) - asset.mesh.textures[0]).max() > 50


def test_a_material_without_a_factor_keeps_its_colours_on_a_shared_image(tmp_path):
    def two(d: dict) -> None:
        d["materials"].append({"pbrMetallicRoughness": dict(d["materials"][0]["pbrMetallicRoughness"])})
        set_(d, "materials", 1, "pbrMetallicRoughness", "baseColorFactor", to=FACTOR)
        other = {**d["meshes"][0]["primitives"][0], "material": 1}
        d["meshes"].append({"primitives": [other]})
        d["nodes"].append({"mesh": 1, "translation": [5, 0, 0]})
        d["scenes"][0]["nodes"] = [0, 1]

    asset = read_asset(gltf(two)(tmp_path))
    mesh = tinted(asset, asset.mesh)
    assert len(asset.mesh.textures) == 1 and [tint.material for tint in tints(asset)] == [1]
    right = asset.mesh.vertices[asset.mesh.faces].mean(1)[:, 0] > 2
    assert np.array_equal(mesh.face_textures, right.astype(int)) and right.any() and not right.all()


def test_the_contact_sheet_shows_what_viewers_show(tmp_path):
    asset = read_asset(at("materials", 0, "pbrMetallicRoughness", "baseColorFactor", to=FACTOR)(tmp_path))
    sheet = side_by_side(asset, [own_painting(asset)], ["same"], "y", 64)
    picture = render.render(tinted(asset, asset.mesh), azimuth=30.0, elevation=20.0, size=64)
    plain = render.render(asset.mesh, azimuth=30.0, elevation=20.0, size=64)
    assert not np.array_equal(picture, plain)
    top, left = 12 + 12 + 12, 12
    for column in range(2):
        x = left + column * (64 + 12)
        assert np.array_equal(sheet[top : top + 64, x : x + 64], picture)


def colored(folder: Path, value: float) -> Path:
    """The usual GLB with one colour at all its vertices."""
    d, content = document()
    d["bufferViews"].append({"buffer": 0, "byteOffset": len(content), "byteLength": 48})
    d["accessors"].append({"bufferView": 4, "componentType": 5126, "count": 4, "type": "VEC3"})
    d["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = 3
    d["buffers"][0]["byteLength"] += 48
    (folder / "a.glb").write_bytes(glb(d, content + np.full(12, value, "<f4").tobytes()))
    return folder / "a.glb"


def test_colours_of_vertices_multiply_a_texture_in_pictures_as_in_viewers(tmp_path):
    white, asset = read_asset(colored(tmp_path, 1.0)), read_asset(colored(tmp_path, 0.5))
    assert corner_tints(white) is None and not tints_in_words(white)
    halves = corner_tints(asset)
    assert halves is not None
    np.testing.assert_allclose(halves, 0.5, atol=1e-5)
    assert tints_in_words(asset) == ["material 0 × the colours of its vertices"]
    view = render.look(asset.mesh, size=64)
    np.testing.assert_allclose(
        render.show(view._replace(gloss=0 * view.gloss), asset.mesh, halves),
        render.show(view._replace(gloss=0 * view.gloss, light=view.light / 2), asset.mesh),
        atol=1,
    )
    sheets = [side_by_side(one, [own_painting(one)], ["same"], "y", 64) for one in (white, asset)]
    assert sheets[0].mean() > sheets[1].mean() + 1 and np.array_equal(
        sheets[1][36:100, 12:76], sheets[1][36:100, 88:152]
    )


def test_what_only_some_viewers_multiply_is_told_and_not_shown(tmp_path):
    asset = read_asset(obj(mtl=MTL.replace("map_Kd", "Kd 0.5 0.25 1\nmap_Kd"))(tmp_path))
    assert tints_in_words(asset) == ["skin × Kd 0.5 0.25 1 (some viewers)"]
    assert corner_tints(asset) is None and not tints(asset)
    vertex = "v 1 0 0"
    assert vertex in OBJ
    lines = [f"{line} 0.5 0.5 0.5" if line.startswith("v ") else line for line in OBJ.splitlines()]
    asset = read_asset(obj(lambda _: "\n".join(lines) + "\n")(tmp_path))
    assert tints_in_words(asset) == ["skin × the colours of its vertices (some viewers)"]
    assert corner_tints(asset) is None
