"""Laws of reading a glTF: its parts lie where another reader puts them."""

import tracemalloc

import numpy as np
import pytest
import trimesh
from helpers.scene import container, save
from reports.hostile import views_of_one_buffer

from flx.assets.asset import Painting
from flx.assets.formats.gltf import Gltf, accessor, parts, read_gltf
from flx.assets.read import read_asset
from flx.assets.write import write


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


def test_views_of_the_same_bytes_take_no_memory_of_their_own(tmp_path):
    path = views_of_one_buffer(200)(tmp_path)
    tracemalloc.start()
    file = read_gltf(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert sum(map(len, file.views)) > 199 << 20 and peak < 10 << 20
    assert file.views[203][: len(file.views[0])] == file.views[0] and any(file.views[0])
