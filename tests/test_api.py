"""The public names: each is there, documented with an example, and loaded only when it is used."""

import ast
import inspect
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import flx
from flx.assets.asset import Asset

FUNCTIONS = [name for name in flx.__all__ if inspect.isfunction(getattr(flx, name))]


def test_the_names_are_those_that_type_checkers_see():
    tree = ast.parse(Path(flx.__file__).read_text())
    block = next(node for node in tree.body if isinstance(node, ast.If))
    seen = [alias.asname or alias.name for node in block.body for alias in node.names]
    assert sorted(seen) == sorted(set(flx.__all__) - {"__version__"})
    homes = {
        alias.asname or alias.name: f"{node.module}.{alias.name}"
        for node in block.body
        for alias in node.names
    }
    for name, home in homes.items():
        value = getattr(flx, name)
        assert f"{value.__module__}.{value.__qualname__}" == home
    assert set(flx.__all__) <= set(dir(flx))


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_function_has_its_arguments_and_an_example_in_its_docstring(name):
    function = getattr(flx, name)
    text = inspect.getdoc(function) or ""
    assert f"flx.{name}(" in text, "show how it is called"
    for argument in inspect.signature(function).parameters:
        assert argument in text, f"say what {argument} is"


def test_a_name_that_is_not_there_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'loat'"):
        _ = flx.loat  # type: ignore


@pytest.mark.slow
def test_there_and_back_from_arrays(tmp_path):
    """Ten lines with nothing but public names, from arrays to a file and its measure."""
    vase = flx.vase()
    mesh = vase.mesh
    image = np.asarray(mesh.textures[0])
    asset = flx.from_arrays(mesh.vertices, mesh.faces, mesh.corner_uvs, image, name="pot")
    copy = flx.triangulate(asset, vertices=600)
    codec = flx.load_codec()
    back = flx.paint(asset, copy, codec, codec.encode(copy.rings), texture_size=128)
    flx.save(asset, back, tmp_path / "pot.glb")
    again = flx.load(tmp_path / "pot.glb")
    assert isinstance(again, Asset) and again.mesh.textures[0].shape == (128, 128, 3)
    np.testing.assert_array_equal(again.mesh.textures[0], back.images[0])
    assert 12 < flx.fidelity(asset, back)["psnr"] < 40
    assert flx.picture(asset, back, size=64).width >= 2 * 64
    assert "<iframe" in flx.show(asset, back)._repr_html_()
    with pytest.raises(ValueError, match=r"give \[600, 8\]: a code for each vertex"):
        flx.paint(asset, copy, codec, np.zeros((5, 8), np.complex64))


@pytest.mark.slow
def test_codes_on_a_triangulation_of_ones_own_see_no_motion_of_the_mesh():
    """`flx.triangulate` alone may give a mesh that was turned another triangulation."""
    rng, mesh = np.random.default_rng(0), flx.vase().mesh
    turn, codec = Rotation.random(rng=rng).as_matrix(), flx.load_codec()
    image, own = np.asarray(mesh.textures[0]), flx.triangulate(flx.vase(), vertices=500).triangulation
    codes = []
    for matrix in (np.eye(3), turn):
        asset = flx.from_arrays(mesh.vertices @ matrix.T, mesh.faces, mesh.corner_uvs, image)
        moved = flx.Triangulation(own.vertices @ matrix.T, own.faces)
        copy = flx.triangulate(asset, triangulation=moved)
        np.testing.assert_array_equal(copy.triangulation.faces, own.faces)
        codes.append(codec.encode(copy.rings))
    assert np.median(np.abs(codes[1] - codes[0])) < 1e-3 < 0.1 < np.std(codes[0])


@pytest.mark.slow
def test_to_trimesh_and_back():
    mesh = flx.to_trimesh(flx.vase())
    assert flx.from_trimesh(mesh).report.faces == len(mesh.faces)
