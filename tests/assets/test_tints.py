"""Laws of factors: pictures show a texture times its factor in linear light; what is written keeps both."""

import numpy as np
from helpers.files import at, gltf, set_

from flx.assets.asset import own_painting
from flx.assets.read import read_asset
from flx.assets.tints import tinted, tints
from flx.geometry.color import linear
from flx.geometry.render import render
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
    picture = render(tinted(asset, asset.mesh), azimuth=30.0, elevation=20.0, size=64)
    plain = render(asset.mesh, azimuth=30.0, elevation=20.0, size=64)
    assert not np.array_equal(picture, plain)
    top, left = 12 + 12 + 12, 12
    for column in range(2):
        x = left + column * (64 + 12)
        assert np.array_equal(sheet[top : top + 64, x : x + 64], picture)
