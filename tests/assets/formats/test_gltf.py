"""Laws of the container: only what is asked for changes; all else keeps its index and its bytes."""

import copy
import io
import json

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from flx.assets.asset import Painting
from flx.assets.formats.glb import glb_bytes, replace_images
from flx.assets.formats.gltf import Gltf, accessor, image_bytes, parts, read_gltf
from flx.assets.preflight import check_output
from flx.assets.read import read_asset
from flx.assets.write import write
from flx.files import write_atomically
from flx.geometry.color import linear, srgb


def png(color, size=(8, 4), alpha=None) -> bytes:
    image = Image.new("RGB", size, color)
    if alpha is not None:
        image.putalpha(Image.new("L", size, alpha))
    content = io.BytesIO()
    image.save(content, format="PNG")
    return content.getvalue()


def container(occlusion_shares: bool = False) -> Gltf:
    """Two materials, three images, extras, names, transformed nodes, a normal map, a line primitive."""
    rng = np.random.default_rng(0)
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    uvs = rng.uniform(size=(4, 2)).astype(np.float32)
    faces = np.array([0, 1, 2, 0, 2, 3], np.uint16)
    views = [points.tobytes(), uvs.tobytes(), faces.tobytes()]
    views += [png((200, 10, 10), alpha=90), png((10, 200, 10)), png((128, 128, 255))]
    document = {
        "asset": {"version": "2.0", "generator": "hand", "extras": {"é": [1, 2.5, None]}},
        "scene": 0,
        "scenes": [{"nodes": [0], "name": "scene"}],
        "nodes": [
            {"name": "root", "children": [1], "translation": [1, 2, 3], "scale": [2, 2, 2]},
            {"name": "leaf", "mesh": 0, "rotation": [0, 0, np.sqrt(0.5), np.sqrt(0.5)], "extras": {"a": 1}},
        ],
        "meshes": [
            {
                "name": "quad",
                "primitives": [
                    {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": i}
                    for i in (0, 1)
                ]
                + [{"attributes": {"POSITION": 0}, "indices": 2, "mode": 1}],
            }
        ],
        "materials": [
            {
                "name": "red",
                "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "baseColorFactor": [0.5, 1, 1, 1]},
                "normalTexture": {"index": 2, "scale": 0.5},
                "alphaMode": "BLEND",
            },
            {"name": "green", "pbrMetallicRoughness": {"baseColorTexture": {"index": 1}}, "extras": "kept"},
        ],
        "textures": [{"source": i, "sampler": 0} for i in range(3)],
        "samplers": [{"wrapS": 33071}],
        "images": [{"bufferView": 3 + i, "mimeType": "image/png", "name": f"image {i}"} for i in range(3)],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": 5126,
                "count": 4,
                "type": "VEC3",
                "min": [0] * 3,
                "max": [1, 1, 0],
            },
            {"bufferView": 1, "componentType": 5126, "count": 4, "type": "VEC2"},
            {"bufferView": 2, "componentType": 5123, "count": 6, "type": "SCALAR"},
        ],
        "bufferViews": [{"buffer": 0, "byteLength": len(view)} for view in views],
    }
    if occlusion_shares:
        document["materials"][1]["occlusionTexture"] = {"index": 1}
    return Gltf(document, tuple(views))


def save(gltf: Gltf, path):
    write_atomically(path, glb_bytes(gltf))
    return path


def save_external(gltf: Gltf, folder):
    """The same file as .gltf, a .bin with an offset, and images beside it."""
    document, binary = copy.deepcopy(gltf.document), b"\0" * 8
    for i, image in enumerate(document["images"]):
        (folder / f"im age{i}.png").write_bytes(gltf.views[image.pop("bufferView")])
        image["uri"] = f"im%20age{i}.png"
    document["bufferViews"] = document["bufferViews"][:3]
    for entry, view in zip(document["bufferViews"], gltf.views, strict=False):
        entry["byteOffset"] = len(binary)
        binary += view + b"\0" * (-len(view) % 4)
    (folder / "data.bin").write_bytes(binary)
    document["buffers"] = [{"byteLength": len(binary), "uri": "data.bin"}]
    (folder / "a.gltf").write_text(json.dumps(document))
    return folder / "a.gltf"


def without_storage(document: dict) -> dict:
    """The document, less what says where bytes lie."""
    document = copy.deepcopy(document)
    for key in ("buffers", "bufferViews"):
        document.pop(key, None)
    for image in document.get("images", []):
        for key in ("bufferView", "uri", "mimeType"):
            image.pop(key, None)
    return document


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


def test_geometry_stands_where_trimesh_puts_it(tmp_path):
    path = save(container(), tmp_path / "a.glb")
    oracle = trimesh.load_scene(path).to_geometry()
    ours = np.concatenate([part.positions[part.faces] for part in parts(read_gltf(path))])
    assert np.allclose(np.sort(ours.reshape(-1, 3), 0), np.sort(oracle.triangles.reshape(-1, 3), 0))


def test_a_mirrored_node_keeps_faces_counter_clockwise_from_outside():
    gltf = container()
    gltf.document["nodes"][1] = {"mesh": 0, "matrix": np.diag([-1.0, 1, 1, 1]).ravel().tolist()}
    part = parts(gltf)[0]
    a, b, c = part.positions[part.faces[0]]
    assert np.cross(b - a, c - a)[2] > 0  # the quad faced +z before it was mirrored in x, and does still


@pytest.mark.parametrize("mirror", [1, -1])
def test_normals_stay_perpendicular_to_their_faces_under_any_transform(mirror):
    """And of length one, on the same side; a transform that flattens leaves them finite."""
    gltf, rng = container(), np.random.default_rng(0)
    points = rng.normal(size=(6, 3)).astype(np.float32)
    a, b, c = points[:3], points[3:], points[[1, 2, 0]]
    normals = 7 * np.cross(b - a, c - a).astype(np.float32)
    rows = np.stack([a, b, c], 1).reshape(-1, 3)
    views = [rows.tobytes(), np.repeat(normals, 3, 0).tobytes()]
    gltf.document["accessors"] = [
        {"bufferView": i, "componentType": 5126, "count": 9, "type": "VEC3"} for i in (0, 1)
    ]
    gltf.document["meshes"][0]["primitives"] = [{"attributes": {"POSITION": 0, "NORMAL": 1}}]
    gltf.document["bufferViews"] = [{}, {}]
    matrix = np.eye(4)
    matrix[:3, :3] = rng.normal(size=(3, 3))
    matrix[0, :3] *= mirror * np.sign(np.linalg.det(matrix[:3, :3]))
    gltf.document["nodes"][1] = {"mesh": 0, "matrix": matrix.T.ravel().tolist()}
    (part,) = parts(Gltf(gltf.document, tuple(views)))
    assert part.normals is not None
    x, y, z = np.moveaxis(part.positions[part.faces], 1, 0)
    wanted = np.cross(y - x, z - x)
    wanted /= np.linalg.norm(wanted, axis=1, keepdims=True)
    np.testing.assert_allclose(part.normals[part.faces], np.repeat(wanted[:, None], 3, 1), atol=1e-5)
    for flat in ([1, 1, 0], [0, 0, 0]):
        matrix = np.diag([*map(float, flat), 1.0]).ravel().tolist()
        gltf.document["nodes"][1] = {"mesh": 0, "matrix": matrix}
        assert np.isfinite(parts(Gltf(gltf.document, tuple(views)))[0].normals).all()


def test_texture_transform_moves_the_coordinates():
    gltf = container()
    slot = gltf.document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    u, v = accessor(gltf, 1).astype(float).T
    slot["extensions"] = {
        "KHR_texture_transform": {"offset": [0.5, 0], "rotation": np.pi / 2, "scale": [2, 1]}
    }
    # The extension's own matrices: translation @ rotation @ scale, rotation = [[cos, sin], [-sin, cos]].
    assert np.allclose(parts(gltf)[0].uvs, np.stack([v + 0.5, -2 * u], 1))


def test_strips_fans_and_triangles_are_the_same_square():
    gltf = container()
    primitives = gltf.document["meshes"][0]["primitives"]
    order = np.array([0, 1, 3, 2, 0, 1, 2, 3], np.uint16)
    view = {"buffer": 0, "byteLength": order.nbytes}
    gltf.document["bufferViews"].append(view)
    gltf.document["accessors"] += [
        {"bufferView": 6, "componentType": 5123, "count": 4, "type": "SCALAR", "byteOffset": offset}
        for offset in (0, 8)
    ]
    primitives[0] |= {"mode": 5, "indices": 3}
    primitives[1] |= {"mode": 6, "indices": 4}
    for part in parts(Gltf(gltf.document, (*gltf.views, order.tobytes()))):
        a, b, c = (part.positions[part.faces[:, i]] for i in range(3))
        normals = np.cross(b - a, c - a)
        assert np.allclose(normals, [0, 0, 4])  # two halves of a square of side 2, both facing up


def test_interleaved_normalised_and_sparse_accessors():
    rows = np.zeros(3, np.dtype([("p", "<f4", 3), ("c", "u1", 4)]))
    rows["p"], rows["c"] = np.arange(9).reshape(3, 3), [[255, 0, 51, 255]] * 3
    where, values = np.array([2], np.uint8), np.array([[9, 9, 9]], np.float32)
    document = {
        "bufferViews": [{"byteStride": 16}, {}, {}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {
                "bufferView": 0,
                "byteOffset": 12,
                "componentType": 5121,
                "count": 3,
                "type": "VEC4",
                "normalized": True,
            },
            {
                "bufferView": 0,
                "componentType": 5126,
                "count": 3,
                "type": "VEC3",
                "sparse": {
                    "count": 1,
                    "indices": {"bufferView": 1, "componentType": 5121},
                    "values": {"bufferView": 2},
                },
            },
        ],
    }
    gltf = Gltf(document, (rows.tobytes(), where.tobytes(), values.tobytes()))
    assert np.array_equal(accessor(gltf, 0), rows["p"])
    assert np.allclose(accessor(gltf, 1), [[1, 0, 0.2, 1]] * 3)
    assert np.array_equal(accessor(gltf, 2), [[0, 1, 2], [3, 4, 5], [9, 9, 9]])


@pytest.mark.parametrize("alpha", [False, True])
def test_vertex_colours_come_back_and_instances_are_told_apart(tmp_path, alpha):
    gltf = container()
    gltf.document["scenes"][0]["nodes"] = [0, 2]
    gltf.document["nodes"].append({"mesh": 0, "translation": [9, 9, 9]})
    for material in gltf.document["materials"]:
        del material["pbrMetallicRoughness"]
    old = np.tile(np.array([0, 65535, 0, 32768], np.uint16)[: 4 if alpha else 3], (4, 1))
    gltf.document["bufferViews"].append({"buffer": 0, "byteLength": old.nbytes, "byteStride": old.strides[0]})
    gltf.document["accessors"].append(
        {
            "bufferView": 6,
            "componentType": 5123,
            "normalized": True,
            "count": 4,
            "type": "VEC4" if alpha else "VEC3",
        }
    )
    gltf.document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = 3
    path = save(Gltf(gltf.document, (*gltf.views, old.tobytes())), tmp_path / "a.glb")
    asset = read_asset(path)
    assert asset.report.color_source == "vertex colours" and len(asset.parts) == 4
    assert np.allclose(asset.parts[0].colors, [0, 1, 0])
    colors = np.random.default_rng(0).uniform(size=(16, 3)).astype(np.float32)
    write(asset, Painting({}, colors), tmp_path / "out.glb")
    again = read_asset(tmp_path / "out.glb")
    assert np.allclose(again.mesh.corner_colors, colors[asset.corner_vertices], atol=1e-6)
    out = read_gltf(tmp_path / "out.glb")
    primitive = out.document["meshes"][0]["primitives"][0]
    written = accessor(out, primitive["attributes"]["COLOR_0"])
    assert written.shape[1] == (4 if alpha else 3)
    assert not alpha or np.allclose(written[:, 3], 32768 / 65535)
    assert np.array_equal(accessor(out, 3), accessor(read_gltf(path), 3))


@given(hnp.arrays(np.float64, 5, elements=st.floats(0, 1)))
def test_srgb_and_linear_are_inverse(values):
    assert np.allclose(linear(srgb(values)), values, atol=1e-12)
    assert np.all(np.diff(srgb(np.sort(values))) >= 0)


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


@pytest.mark.parametrize(
    "spoil, match",
    [
        (lambda d: d.update(extensionsUsed=["KHR_draco_mesh_compression"]), "compressed"),
        (lambda d: d["accessors"][0].update(count=10**9), "do not fit"),
        (lambda d: d["meshes"][0]["primitives"][0].update(indices=99), r"indices is 99, not one of 3"),
        (lambda d: d["scenes"][0].update(nodes=[]), "no triangles"),
        (lambda d: d["images"][0].update(uri="../secret.png"), "outside"),
        (lambda d: d["images"][0].update(uri="gone.png"), "gone.png"),
    ],
)
def test_a_spoilt_file_is_one_line_that_names_it(tmp_path, spoil, match):
    gltf = container()
    spoil(gltf.document)
    if "uri" in gltf.document["images"][0]:
        del gltf.document["images"][0]["bufferView"]
    path = save(gltf, tmp_path / "a.glb")
    with pytest.raises(ValueError, match=match) as caught:
        read_asset(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_what_an_obj_would_not_have_is_named_in_one_line(tmp_path, capsys):
    gltf = container(occlusion_shares=True)
    document = gltf.document
    document["images"][1]["name"] = "two\nlines"
    document["materials"][0]["pbrMetallicRoughness"] |= {"roughnessFactor": 0.7, "metallicFactor": 0}
    document["materials"][0]["emissiveFactor"] = [1, 1, 1]
    document["meshes"][0]["primitives"][0]["attributes"] |= {"TEXCOORD_1": 1, "TANGENT": 0}
    document |= {"extensionsUsed": ["KHR_texture_transform", "KHR_materials_sheen"], "cameras": [{}]}
    document["asset"]["copyright"] = "me"
    asset = read_asset(save(gltf, tmp_path / "a.glb"))
    told = "two lines, image 2, baseColorFactor, alphaMode, roughnessFactor, emissiveFactor, TEXCOORD_1, "
    told += "TANGENT, lines and points, cameras, KHR_materials_sheen, 2 nodes, copyright, extras"
    for format, said in (("glb", ""), ("obj", f"{asset.path}: {told} stay behind; --format glb keeps all\n")):
        check_output(asset, format, [tmp_path / f"out.{format}"])
        assert capsys.readouterr().err == said


@pytest.mark.parametrize("given", [False, True])
def test_a_file_that_is_not_there_and_is_still_named_is_told(tmp_path, capsys, given):
    """The base colour's image is replaced: it is named no more."""
    gltf = container()
    for image in range(3):
        if given or image == 2:
            gltf.document["images"][image] = {"uri": f"gone {image}.png"}
    (tmp_path / "a.png").write_bytes(png((1, 2, 3)))
    gltf.document["materials"][1]["pbrMetallicRoughness"]["baseColorTexture"]["index"] = 0
    asset = read_asset(save(gltf, tmp_path / "a.glb"), tmp_path / "a.png" if given else None)
    told = "gone 1.png, gone 2.png" if given else "gone 2.png"
    check_output(asset, "glb", [tmp_path / "out.glb"])
    assert capsys.readouterr().err == f"{asset.path}: not there, but named in what is written: {told}\n"
    write(asset, Painting({"base_color": asset.mesh.textures}), tmp_path / "out.glb")
    assert ", ".join(read_asset(tmp_path / "out.glb").report.missing_images) == told
