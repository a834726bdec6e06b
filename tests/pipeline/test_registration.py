"""A law of registration: what comes from one height in the input still does where pieces are turned."""

from helpers.bumps import bumpy, registration
from pipeline.test_instant import sheet

from flx.assets.asset import Painting
from flx.controls import Patches
from flx.pipeline.instant import patch_generator, patchworks
from flx.types import TexturedMesh


def painted(mesh: TexturedMesh, painting: Painting) -> TexturedMesh:
    layers = {slot: layer._replace(images=painting.maps[slot]) for slot, layer in mesh.maps.items()}
    return mesh._replace(maps=layers)


def test_colours_normals_and_roughness_of_a_patchwork_are_in_register():
    asset = bumpy(sheet(), 256, 60)
    before = registration(asset.mesh)
    assert before["normal"] > 0.9 and before["roughness"] > 0.99
    new = painted(asset.mesh, next(patchworks(patch_generator(asset, Patches(vertices=400)))))
    found = registration(new)
    assert found["normal"] > 0.9 * before["normal"] and found["roughness"] > 0.95
    stays = new._replace(maps={**asset.mesh.maps, "base_color": new.maps["base_color"]})
    assert max(registration(stays).values()) < 0.3
