"""Laws of maps besides base colours: read where asked, at their own coordinates and depth; written alone."""

import copy
import io
import json
import os
import shutil
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from helpers.scene import container, png, save, without_storage
from PIL import Image

from flx.assets.asset import Painting, own_painting
from flx.assets.formats.gltf import Gltf, accessor, append, append_view, image_bytes, read_gltf
from flx.assets.formats.images import decode_map, encode_png
from flx.assets.inspect import other_maps
from flx.assets.read import read_asset
from flx.assets.write import write
from flx.geometry.atlas import atlas_texels, paint, with_filled_gutters
from flx.geometry.sampling import surface_colors
from flx.geometry.seams import seam_jump
from flx.pipeline.canvas import shown
from flx.types import SurfacePoints, is_srgb

EVERY = ("base_color", "normal", "metallic_roughness", "occlusion", "emissive")


def deep_png(pixels: np.ndarray) -> bytes:
    """A 16-bit PNG without filters, by nothing of ours."""
    height, width, channels = pixels.shape
    lines = b"".join(b"\0" + row.astype(">u2").tobytes() for row in pixels)
    head = struct.pack(">IIBBBBB", width, height, 16, {1: 0, 3: 2, 4: 6}[channels], 0, 0, 0)
    chunks = ((b"IHDR", head), (b"IDAT", zlib.compress(lines)), (b"IEND", b""))
    body = b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + body


def numbers(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 1 << 16, shape, np.uint16)


NORMALS = numbers(6, 5, 3)


def with_maps(shared: bool = False) -> Gltf:
    """The file of `test_gltf`: material 0 with a 16-bit normal map, metallic-roughness and, where `shared`,
    the latter's image for occlusion, too. Material 1 has neither, and shows on a square beside the first."""
    gltf = container()
    document, views = copy.deepcopy(gltf.document), list(gltf.views)
    views[document["images"][2]["bufferView"]] = deep_png(NORMALS)
    image = append(document, "images", {"name": "arm", "mimeType": "image/png"})
    document["images"][image]["bufferView"] = append_view(document, views, png((40, 80, 120)))
    texture = append(document, "textures", {"source": image, "sampler": 0})
    beside = np.array([[1, 0, 0], [2, 0, 0], [2, 1, 0], [1, 1, 0]], np.float32)
    entry = document["accessors"][0] | {"bufferView": append_view(document, views, beside.tobytes())}
    entry |= {"min": [1, 0, 0], "max": [2, 1, 0]}
    position = append(document, "accessors", entry)
    document["meshes"][0]["primitives"][1]["attributes"]["POSITION"] = position
    material = document["materials"][0]
    material["pbrMetallicRoughness"]["metallicRoughnessTexture"] = {"index": texture}
    if shared:
        material["occlusionTexture"] = {"index": texture, "strength": 0.5}
    return Gltf(document, tuple(views))


# --- depth


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_sixteen_bits_of_a_png_are_read_exactly(channels):
    pixels = numbers(7, 9, channels)
    found, alpha = decode_map(deep_png(pixels), "deep")
    np.testing.assert_array_equal(found, np.broadcast_to(pixels[..., :3], (7, 9, 3)))
    assert found.dtype == np.uint16
    assert (alpha is None) == (channels < 4)
    assert alpha is None or (alpha == pixels[..., 3] >> 8).all()
    eight, _ = decode_map(png((1, 2, 3)), "flat")
    assert eight.dtype == np.uint8


def test_an_image_is_written_in_its_own_depth():
    for alpha in (None, np.random.default_rng(1).integers(0, 255, (7, 9)).astype(np.uint8)):
        content = encode_png(numbers(7, 9, 3), alpha)
        again, mask = decode_map(content, "again")
        np.testing.assert_array_equal(again, numbers(7, 9, 3))
        assert np.array_equal(mask, alpha) if alpha is not None else mask is None
        high = np.asarray(Image.open(io.BytesIO(content)).convert("RGB"))  # another reader, in 8 bits
        np.testing.assert_array_equal(high, numbers(7, 9, 3) >> 8)
    assert len(encode_png(np.full((64, 64, 3), 9, np.uint16), None)) < 300  # it is compressed


# --- reading


def test_what_is_not_asked_for_is_not_decoded(tmp_path):
    gltf = with_maps()
    views = list(gltf.views)
    views[gltf.document["images"][2]["bufferView"]] = b"no image"
    path = save(Gltf(gltf.document, tuple(views)), tmp_path / "a.glb")
    asset = read_asset(path)
    assert set(asset.mesh.maps) == {"base_color"}
    assert set(read_asset(path, slots=["metallic_roughness"]).mesh.maps) == {
        "base_color",
        "metallic_roughness",
    }
    with pytest.raises(ValueError, match=r"a\.glb: image 'image 2 #2' is of no known kind"):
        read_asset(path, slots=["normal"])


def test_other_maps_are_named_with_size_and_depth_whether_read_or_not(tmp_path):
    path = save(with_maps(shared=True), tmp_path / "a.glb")
    expected = [
        ("normal", "image 2 #2", 5, 6, 16),
        ("metallic_roughness", "arm #3", 8, 4, 8),
        ("occlusion", "arm #3", 8, 4, 8),
    ]
    for slots in (["base_color"], ["base_color", "normal"]):
        assert [tuple(each) for each in other_maps(read_asset(path, slots=slots))] == expected
    lost = copy.deepcopy(with_maps())
    del lost.document["images"][2]["bufferView"]
    assert other_maps(read_asset(save(lost, tmp_path / "b.glb")))[0][2:] == (0, 0, 0)


def test_a_slot_has_its_own_numbers_depth_and_flat_values(tmp_path):
    path = save(with_maps(shared=True), tmp_path / "a.glb")
    asset = read_asset(path, slots=EVERY[:4])
    assert [is_srgb(slot) for slot in EVERY] == [True, False, False, False, True]
    image, flat = asset.mesh.maps["normal"].images
    np.testing.assert_array_equal(image, NORMALS)
    assert (flat == [128, 128, 255]).all()  # of the material without a normal map
    assert [t.flat for t in asset.sources["normal"]] == [False, True]
    rough, plain = asset.mesh.maps["metallic_roughness"].images
    assert (rough == [40, 80, 120]).all() and (plain == 255).all()  # factors of 1, glTF's default
    middles = SurfacePoints(np.arange(4), np.full((4, 3), 1 / 3))
    seen = surface_colors(asset.mesh, middles, "metallic_roughness")
    first = asset.mesh.maps["metallic_roughness"].face_images == 0
    assert first.sum() == 2
    np.testing.assert_allclose(seen[first], np.tile([40 / 255, 80 / 255, 120 / 255], (2, 1)), atol=1e-6)
    corners = asset.mesh.corner_uvs[first][:1]
    uv = corners.mean(1)[0] * [5, 6] - 0.5
    value = surface_colors(
        asset.mesh, SurfacePoints(np.flatnonzero(first)[:1], middles.barycentrics[:1]), "normal"
    )
    left, top = np.floor(uv).astype(int)
    x, y = uv - [left, top]
    texel = lambda i, j: NORMALS[j % 6, i % 5] / 65535  # noqa: E731
    mean = (1 - y) * ((1 - x) * texel(left, top) + x * texel(left + 1, top))
    mean += y * ((1 - x) * texel(left, top + 1) + x * texel(left + 1, top + 1))
    np.testing.assert_allclose(value[0], mean, atol=1e-6)


def test_a_flat_emission_is_kept_as_srgb_and_what_is_no_number_counts_as_none(tmp_path):
    gltf = with_maps()
    material = gltf.document["materials"][0]
    material["emissiveTexture"] = {"index": 3}
    for factor, level in (([0.5, 0, 1], 188), ("bright", 0), ([1, 2], 0)):
        gltf.document["materials"][1]["emissiveFactor"] = factor
        asset = read_asset(save(gltf, tmp_path / "a.glb"), slots=["emissive"])
        assert asset.mesh.maps["emissive"].images[1][0, 0, 0] == level  # linear ½ is sRGB 188


def test_a_map_is_read_at_its_own_coordinates(tmp_path):
    """Another set, moved by KHR_texture_transform; base colours stay where they are."""
    gltf = with_maps()
    plain = read_asset(save(gltf, tmp_path / "a.glb"), slots=["normal"]).mesh
    other = np.random.default_rng(5).uniform(size=(4, 2)).astype(np.float32)
    document, views = copy.deepcopy(gltf.document), list(gltf.views)
    entry = {"componentType": 5126, "count": 4, "type": "VEC2"}
    entry["bufferView"] = append_view(document, views, other.tobytes())
    for primitive in document["meshes"][0]["primitives"][:2]:
        primitive["attributes"]["TEXCOORD_1"] = len(document["accessors"])
    append(document, "accessors", entry)
    document["materials"][0]["normalTexture"] |= {
        "texCoord": 1,
        "extensions": {"KHR_texture_transform": {"offset": [0.25, 0.5], "scale": [2, 3]}},
    }
    mesh = read_asset(save(Gltf(document, tuple(views)), tmp_path / "b.glb"), slots=["normal"]).mesh
    np.testing.assert_array_equal(mesh.corner_uvs, plain.corner_uvs)
    np.testing.assert_array_equal(plain.maps["normal"].corner_uvs, plain.corner_uvs)
    first = mesh.face_textures == 0
    uvs = mesh.maps["normal"].corner_uvs
    expected = (other * np.float64([2, 3]) + [0.25, 0.5])[[[0, 1, 2], [0, 2, 3]]]
    np.testing.assert_allclose(uvs[first], expected, atol=1e-12)
    np.testing.assert_array_equal(uvs[~first], plain.corner_uvs[~first])


def test_a_slot_that_no_material_has_is_refused_by_name(tmp_path):
    path = save(with_maps(), tmp_path / "a.glb")
    with pytest.raises(ValueError, match=r"there is no emissive map \(.*metallic_roughness, normal\)"):
        read_asset(path, slots=["emissive"])


def test_maps_count_in_the_digest_only_where_they_are_read(tmp_path):
    path = save(with_maps(), tmp_path / "a.glb")
    changed = with_maps()
    views = list(changed.views)
    views[changed.document["images"][2]["bufferView"]] = deep_png(NORMALS + np.uint16(1))
    other = save(Gltf(changed.document, tuple(views)), tmp_path / "b.glb")
    assert read_asset(path).digest == read_asset(other).digest
    one, two = (read_asset(p, slots=["normal"]).digest for p in (path, other))
    assert len({one, two, read_asset(path).digest}) == 3


def test_the_limit_of_pixels_counts_all_images_that_are_read(tmp_path, monkeypatch):
    path = save(with_maps(), tmp_path / "a.glb")
    monkeypatch.setenv("FLX_MAX_PIXELS", "32")  # two base colours of 8 × 4; four times as many in all
    read_asset(path, slots=["base_color", "normal"])
    views = list(with_maps().views)
    big = with_maps().document
    views[big["images"][2]["bufferView"]] = deep_png(numbers(11, 3, 3))
    path = save(Gltf(big, tuple(views)), tmp_path / "b.glb")
    read_asset(path)
    pillows = Image.MAX_IMAGE_PIXELS
    with pytest.raises(ValueError, match=r"3 × 11 pixels, more than 32"):
        read_asset(path, slots=["normal"])
    assert Image.MAX_IMAGE_PIXELS == pillows != 32  # other programs' images are not our business


# --- writing


@pytest.mark.parametrize("shared", [False, True])
def test_only_the_normal_map_changes(tmp_path, shared):
    gltf = with_maps(shared)
    asset = read_asset(save(gltf, tmp_path / "a.glb"), slots=EVERY[:3])
    new = numbers(12, 10, 3, seed=3)
    write(asset, Painting({"normal": (new, asset.mesh.maps["normal"].images[1])}), tmp_path / "out.glb")
    out = read_gltf(tmp_path / "out.glb")
    assert without_storage(out.document) == without_storage(gltf.document)
    changed = gltf.document["images"][2]["bufferView"]
    assert out.views[changed] != gltf.views[changed]
    assert [v for i, v in enumerate(out.views) if i != changed] == [
        v for i, v in enumerate(gltf.views) if i != changed
    ]
    for index in range(3):
        assert np.array_equal(accessor(out, index), accessor(gltf, index))
    again = read_asset(tmp_path / "out.glb", slots=EVERY[:3])
    assert again.mesh.maps["normal"].images[0].dtype == np.uint16
    np.testing.assert_array_equal(again.mesh.maps["normal"].images[0], new)
    assert read_asset(tmp_path / "out.glb").digest == read_asset(tmp_path / "a.glb").digest
    for slot in ("base_color", "metallic_roughness"):
        for one, two in zip(again.mesh.maps[slot].images, asset.mesh.maps[slot].images, strict=True):
            np.testing.assert_array_equal(one, two)


def test_an_image_that_another_slot_shows_stays(tmp_path):
    gltf = with_maps(shared=True)
    asset = read_asset(save(gltf, tmp_path / "a.glb"), slots=["metallic_roughness", "occlusion"])
    new = np.full((4, 4, 3), 9, np.uint8)
    flat = asset.mesh.maps["metallic_roughness"].images[1]
    write(asset, Painting({"metallic_roughness": (new, flat)}), tmp_path / "out.glb")
    out = read_gltf(tmp_path / "out.glb")
    assert image_bytes(out, 3) == image_bytes(gltf, 3) and len(out.document["images"]) == 5
    assert out.document["materials"][0]["occlusionTexture"] == {"index": 3, "strength": 0.5}
    again = read_asset(tmp_path / "out.glb", slots=["metallic_roughness", "occlusion"]).mesh
    assert (again.maps["metallic_roughness"].images[0] == 9).all()
    assert (again.maps["occlusion"].images[0] == [40, 80, 120]).all()
    both = {"metallic_roughness": (new, flat), "occlusion": (new + np.uint8(1), flat)}
    write(asset, Painting(both), tmp_path / "both.glb")
    again = read_asset(tmp_path / "both.glb", slots=["metallic_roughness", "occlusion"]).mesh
    assert (again.maps["metallic_roughness"].images[0] == 9).all()
    assert (again.maps["occlusion"].images[0] == 10).all()


def test_vertex_colours_stay_where_only_another_map_is_new(tmp_path):
    gltf = with_maps()
    document, views = copy.deepcopy(gltf.document), list(gltf.views)
    for material in document["materials"]:
        material["pbrMetallicRoughness"].pop("baseColorTexture")
    colors = np.random.default_rng(0).uniform(size=(4, 3)).astype(np.float32)
    entry = document["accessors"][0] | {"bufferView": append_view(document, views, colors.tobytes())}
    number = append(document, "accessors", entry)
    for primitive in document["meshes"][0]["primitives"][:2]:
        primitive["attributes"]["COLOR_0"] = number
    asset = read_asset(save(Gltf(document, tuple(views)), tmp_path / "a.glb"), slots=["normal"])
    assert asset.report.color_source == "vertex colours"
    new = numbers(3, 3, 3)
    write(asset, Painting({"normal": (new, asset.mesh.maps["normal"].images[1])}), tmp_path / "out.glb")
    again = read_asset(tmp_path / "out.glb", slots=["normal"])
    assert read_asset(tmp_path / "out.glb").digest == read_asset(asset.path).digest
    np.testing.assert_array_equal(again.mesh.maps["normal"].images[0], new)
    assert without_storage(read_gltf(tmp_path / "out.glb").document) == without_storage(document)
    with pytest.raises(ValueError, match="0 colours for the 8 vertices"):
        write(asset, Painting({}), tmp_path / "none.glb")


def test_a_painting_that_does_not_fit_is_refused_in_one_line(tmp_path):
    asset = read_asset(save(with_maps(), tmp_path / "a.glb"), slots=["normal"])
    maps = asset.mesh.maps["normal"].images
    for painting, name, words in (
        (
            Painting({"occlusion": maps}),
            "o.glb",
            r"read without its occlusion map; read it with slots=\['occl",
        ),
        (Painting({"normal": maps[:1]}), "o.glb", "1 images for the 2 normal images of .*give one for each"),
        (Painting({"normal": maps}), "o.obj", "cannot write normal maps as OBJ; write a GLB"),
        (Painting({"normal": maps}), "o.ply", "cannot write normal maps as PLY; write a GLB"),
        (Painting({}), "o.glb", "no base colour image for"),
    ):
        with pytest.raises(ValueError, match=words) as refusal:
            write(asset, painting, tmp_path / name)
        assert "\n" not in str(refusal.value) and not (tmp_path / name).exists()


def test_its_own_painting_gives_the_same_asset(tmp_path):
    asset = read_asset(save(with_maps(shared=True), tmp_path / "a.glb"), slots=EVERY[:4])
    write(asset, own_painting(asset), tmp_path / "out.glb")
    assert read_asset(tmp_path / "out.glb", slots=EVERY[:4]).digest == asset.digest


# --- OBJ

OBJ = "mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl a\nf 1/1 2/2 3/3\n"


def obj(folder: Path, *lines: str) -> Path:
    for name in ("c", "rock_normal", "n", "height", "glow"):
        Image.new("RGB", (2, 2), (len(name), 20, 30)).save(folder / f"{name}.png")
    (folder / "m.mtl").write_text("\n".join(["newmtl a", "map_Kd c.png", *lines, ""]))
    (folder / "a.obj").write_text(OBJ)
    return folder / "a.obj"


@pytest.mark.parametrize(
    ("lines", "names"),
    [
        (["norm n.png", "map_Ke glow.png"], {"normal": "n.png", "emissive": "glow.png"}),
        (["map_Bump -bm 1 rock_normal.png"], {"normal": "rock_normal.png"}),
        (["map_Bump rock_normal.png", "norm n.png"], {"normal": "n.png"}),
        (["norm n.png", "bump rock_normal.png"], {"normal": "n.png"}),
        (["bump height.png", "map_Ns c.png"], {}),
    ],
)
def test_an_obj_names_its_maps(tmp_path, lines, names):
    path = obj(tmp_path, *lines)
    asset = read_asset(path)
    assert asset.map_names == {slot: (name,) for slot, name in names.items()}
    if names:
        mesh = read_asset(path, slots=list(names)).mesh
        assert {slot: mesh.maps[slot].images[0][0, 0, 0] for slot in names} == {
            slot: len(name) - 4 for slot, name in names.items()
        }


@pytest.mark.parametrize(
    ("lines", "slot", "words"),
    [
        (["map_Pr n.png"], "metallic_roughness", "map_Pr and map_Pm of 'a' are not read; convert"),
        (["norm -s 2 2 2 n.png"], "normal", "the normal map of 'a' and its map_Kd have -s or -o; convert"),
        (["norm n.png"], "occlusion", "there is no occlusion map"),
        (["norm gone.png"], "normal", "'gone.png' does not exist; put it next to the mesh$"),
    ],
)
def test_what_an_obj_cannot_give_is_refused_by_name(tmp_path, lines, slot, words):
    path = obj(tmp_path, *lines)
    read_asset(path)
    with pytest.raises(ValueError, match=words):
        read_asset(path, slots=[slot])


def test_a_glb_made_of_an_obj_has_the_maps_that_were_read(tmp_path):
    asset = read_asset(obj(tmp_path, "norm n.png", "map_Ke glow.png"), slots=["normal", "emissive"])
    new = numbers(4, 4, 3)
    write(asset, Painting({"normal": (new,)}), tmp_path / "out.glb")
    again = read_asset(tmp_path / "out.glb", slots=["normal", "emissive"])
    np.testing.assert_array_equal(again.mesh.maps["normal"].images[0], new)
    np.testing.assert_array_equal(again.mesh.textures[0], asset.mesh.textures[0])
    assert (again.mesh.maps["emissive"].images[0] == [4, 20, 30]).all()
    material = read_gltf(tmp_path / "out.glb").document["materials"][0]
    assert material["emissiveFactor"] == [1, 1, 1] and "normalTexture" in material  # a factor of 0 hides it


# --- geometry on a slot


def test_atlas_gutters_seams_and_paint_work_on_a_slot(tmp_path):
    asset = read_asset(save(with_maps(), tmp_path / "a.glb"), slots=["normal"])
    layer = asset.mesh.maps["normal"]
    shifted = asset.mesh.with_layer("normal", corner_uvs=layer.corner_uvs * 0.25 + 0.5)
    atlas = atlas_texels(shifted, 0, 32, 32, slot="normal")
    assert 0 < atlas.covered.sum() < atlas_texels(shifted, 0, 32, 32).covered.sum()
    assert not atlas.covered[:15, :15].any()
    values = np.random.default_rng(0).uniform(size=(int(atlas.covered.sum()), 3)).astype(np.float32)
    image = paint(atlas, values, dtype=np.uint16)
    assert image.dtype == np.uint16
    np.testing.assert_allclose(image[atlas.covered] / 65535, values, atol=1e-5)
    bare = np.where(atlas.covered[..., None], image, np.uint16(0))
    filled = with_filled_gutters(shifted.with_layer("normal", images=(bare, layer.images[1])))
    np.testing.assert_array_equal(filled.maps["normal"].images[0], image)
    assert (bare != image).any()
    jumps = [seam_jump(asset.mesh, "normal"), seam_jump(asset.mesh)]
    assert None not in jumps and jumps[0] != jumps[1]
    flat = asset.mesh.vertices[asset.mesh.faces][..., :2] / 8
    whole = asset.mesh.with_layer("normal", corner_uvs=flat, face_images=np.zeros_like(layer.face_images))
    assert seam_jump(whole, "normal") is None
    new = shown(asset, Painting({"normal": (image, layer.images[1])}))
    assert new.maps["normal"].images[0] is image and new.textures is asset.mesh.textures


# --- real data


def test_a_boulder_gets_a_new_normal_map_and_nothing_else(tmp_path):
    if "FLX_DATA" not in os.environ:
        pytest.skip("FLX_DATA is not set: it names a folder with meshes/*/info.json")
    source = Path(os.environ["FLX_DATA"]) / "meshes" / "polyhaven_boulder_01"
    shutil.copytree(source, tmp_path / "in")
    names = [image["uri"] for image in json.loads((source / "boulder_01_1k.gltf").read_text())["images"]]
    normals = numbers(64, 64, 3)
    (tmp_path / "in" / names[0]).write_bytes(deep_png(normals))
    Image.new("RGB", (32, 32), (255, 200, 0)).save(tmp_path / "in" / names[2])
    asset = read_asset(tmp_path / "in" / "boulder_01_1k.gltf", slots=["normal", "metallic_roughness"])
    np.testing.assert_array_equal(asset.mesh.maps["normal"].images[0], normals)
    new = numbers(64, 64, 3, seed=1)
    write(asset, Painting({"normal": [new]}), tmp_path / "out.glb")
    before, after = asset.container, read_gltf(tmp_path / "out.glb")
    assert isinstance(before, Gltf) and without_storage(before.document) == without_storage(after.document)
    assert sum(one != two for one, two in zip(before.views, after.views, strict=True)) == 1
    again = read_asset(tmp_path / "out.glb", slots=["normal"])
    np.testing.assert_array_equal(again.mesh.maps["normal"].images[0], new)
    assert read_asset(tmp_path / "out.glb").digest == read_asset(asset.path).digest
