"""Laws of the container: only what is asked for changes; all else keeps its index and its bytes."""

import copy
import io

import numpy as np
import pytest
from helpers.scene import container, png, save, save_external, without_storage
from PIL import Image

from flx.assets.asset import Painting
from flx.assets.formats.glb import replace_images
from flx.assets.formats.gltf import Gltf, accessor, image_bytes, read_gltf
from flx.assets.read import read_asset
from flx.assets.write import write


@pytest.mark.parametrize("external", [False, True])
def test_only_the_base_colour_images_change(tmp_path, external):
    gltf = container()
    path = save_external(gltf, tmp_path) if external else save(gltf, tmp_path / "a.glb")
    asset = read_asset(path)
    assert [t.shape for t in asset.mesh.textures] == [(4, 8, 3)] * 2
    assert tuple(asset.mesh.textures[0][0, 0]) == (200, 10, 10)
    new = [np.full((16, 16, 3), 7, np.uint8), np.full((2, 2, 3), 9, np.uint8)]
    write(asset, Painting({"base_color": new}), tmp_path / "out.glb")
    out = read_gltf(tmp_path / "out.glb")
    assert without_storage(out.document) == without_storage(gltf.document)
    assert all(view["byteOffset"] % 4 == 0 for view in out.document["bufferViews"])
    for index in range(3):
        assert np.array_equal(accessor(out, index), accessor(gltf, index))
    assert image_bytes(out, 2) == image_bytes(gltf, 2)
    again = read_asset(tmp_path / "out.glb")
    assert all(np.array_equal(a, b) for a, b in zip(again.mesh.textures, new, strict=True))
    assert again.textures[0].alpha is not None and (again.textures[0].alpha == 90).all()
    assert again.textures[1].alpha is None
    assert np.array_equal(again.mesh.corner_uvs, asset.mesh.corner_uvs)


def test_an_image_that_occlusion_shares_stays_for_occlusion(tmp_path):
    gltf = container(occlusion_shares=True)
    asset = read_asset(save(gltf, tmp_path / "a.glb"))
    write(
        asset,
        Painting({"base_color": [np.full((4, 4, 3), v, np.uint8) for v in (50, 60)]}),
        tmp_path / "out.glb",
    )
    out = read_gltf(tmp_path / "out.glb")
    green = out.document["materials"][1]
    assert green["occlusionTexture"] == {"index": 1} and image_bytes(out, 1) == image_bytes(gltf, 1)
    assert green["pbrMetallicRoughness"]["baseColorTexture"]["index"] == 3
    assert out.document["textures"][3]["sampler"] == 0
    assert [int(t[0, 0, 0]) for t in read_asset(tmp_path / "out.glb").mesh.textures] == [50, 60]


def test_two_materials_of_one_image_share_the_new_one(tmp_path):
    gltf = container()
    gltf.document["materials"][1]["pbrMetallicRoughness"]["baseColorTexture"]["index"] = 0
    asset = read_asset(save(gltf, tmp_path / "a.glb"))
    assert len(asset.mesh.textures) == 1
    write(asset, Painting({"base_color": [np.full((4, 4, 3), 5, np.uint8)]}), tmp_path / "out.glb")
    out = read_gltf(tmp_path / "out.glb")
    assert len(out.document["images"]) == 3 and image_bytes(out, 1) == image_bytes(gltf, 1)


def test_a_texture_is_given_to_materials_and_primitives_that_had_none(tmp_path):
    gltf = container()
    for material in gltf.document["materials"]:
        del material["pbrMetallicRoughness"]
    del gltf.document["meshes"][0]["primitives"][1]["material"]
    (tmp_path / "t.png").write_bytes(png((1, 2, 3)))
    path = save(gltf, tmp_path / "a.glb")
    with pytest.raises(ValueError, match="no material has a base colour texture"):
        read_asset(path)
    asset = read_asset(path, tmp_path / "t.png")
    write(asset, Painting({"base_color": asset.mesh.textures}), tmp_path / "out.glb")
    assert read_asset(tmp_path / "out.glb").digest == asset.digest


def test_webp_sources_are_read_and_leave_with_the_image(tmp_path):
    gltf = container()
    content = io.BytesIO()
    Image.new("RGB", (4, 4), (0, 0, 255)).save(content, format="WEBP", lossless=True)
    gltf.document["textures"][1] = {"extensions": {"EXT_texture_webp": {"source": 1}}}
    views = list(gltf.views)
    views[4] = content.getvalue()
    asset = read_asset(save(Gltf(gltf.document, tuple(views)), tmp_path / "a.glb"))
    assert tuple(asset.mesh.textures[1][0, 0]) == (0, 0, 255)
    write(asset, Painting({"base_color": asset.mesh.textures}), tmp_path / "out.glb")
    out = read_gltf(tmp_path / "out.glb")
    assert out.document["textures"][1] == {"source": 1}
    assert out.document["images"][1]["mimeType"] == "image/png"


def test_the_input_container_is_not_changed():
    gltf = container()
    before = copy.deepcopy(gltf)
    replace_images(gltf, "base_color", {0: 0, 1: 1}, {0: b"a", 1: b"b"})
    assert gltf == before
