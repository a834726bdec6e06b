"""Laws of variants: geometry once, one image for each, the first shown by all, valid glTF."""

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from helpers.files import MTL, colored_ball, gltf, obj

from flx.assets.asset import Painting
from flx.assets.formats.glb import glb_bytes
from flx.assets.formats.gltf import read_gltf
from flx.assets.read import read_asset
from flx.assets.variants import EXTENSION, check_variants, write_variants
from flx.assets.write import write

COLORS = [(255, 0, 0), (0, 255, 0), (0, 0, 255)]
VALIDATOR = Path(__file__).parents[2] / ".pytest_cache" / "npm"
SCRIPT = """
const validator = require("gltf-validator"), bytes = require("fs").readFileSync(process.argv[1]);
validator.validateBytes(new Uint8Array(bytes)).then(r => console.log(JSON.stringify(r.issues)));
"""


def painted(asset, color) -> Painting:
    return Painting({"base_color": [np.full_like(image, color) for image in asset.mesh.textures]})


def two_materials(folder: Path) -> Path:
    text = MTL + "newmtl other\nmap_Kd a.png\n"
    return obj(lambda t: t.replace("f 2/1", "usemtl other\nf 2/1"), text)(folder)


bounded = gltf(lambda d: d["accessors"][0].update(min=[0.0] * 3, max=[1.0] * 3))


@pytest.fixture(params=[bounded, two_materials], ids=["GLB", "OBJ"])
def variants(request, tmp_path):
    """The asset, and the file of its three variants."""
    asset = read_asset(request.param(tmp_path))
    named = [(f"variation {n}", painted(asset, color)) for n, color in enumerate(COLORS)]
    write_variants(asset, named, tmp_path / "out" / "variants.glb")
    return asset, tmp_path / "out" / "variants.glb"


def test_each_variant_shows_its_own_image_on_the_same_geometry(variants, tmp_path):
    asset, path = variants
    file = read_gltf(path)
    write(asset, painted(asset, COLORS[0]), tmp_path / "one.glb")
    one = read_gltf(tmp_path / "one.glb")
    assert file.document["accessors"] == one.document["accessors"]
    assert len(file.views) == len(one.views) + 2 * len(asset.textures)
    assert [v["name"] for v in file.document["extensions"][EXTENSION]["variants"]] == [
        f"variation {n}" for n in range(3)
    ]
    assert EXTENSION in file.document["extensionsUsed"]
    assert (read_asset(path).mesh.textures[0] == COLORS[0]).all()  # what other viewers show
    for n, color in enumerate(COLORS):
        document = json.loads(json.dumps(file.document))
        for primitive in document["meshes"][0]["primitives"]:
            mappings = primitive["extensions"][EXTENSION]["mappings"]
            primitive["material"] = next(m["material"] for m in mappings if n in m["variants"])
        chosen = tmp_path / f"chosen{n}.glb"
        chosen.write_bytes(glb_bytes(file._replace(document=document)))
        shown = read_asset(chosen).mesh
        assert all((image == color).all() for image in shown.textures), n


def test_old_variants_are_left_out(variants, tmp_path):
    again = read_asset(variants[1])
    write_variants(again, [("only", painted(again, COLORS[1]))], tmp_path / "again.glb")
    document = read_gltf(tmp_path / "again.glb").document
    assert document["extensions"][EXTENSION]["variants"] == [{"name": "only"}]
    for primitive in document["meshes"][0]["primitives"]:
        (mapping,) = primitive["extensions"][EXTENSION]["mappings"]
        assert mapping == {"material": primitive["material"], "variants": [0]}


def test_variants_of_another_format_or_without_a_texture_are_refused(tmp_path):
    ball = read_asset(colored_ball(tmp_path))
    with pytest.raises(ValueError, match="has no texture, which variants need; leave out"):
        check_variants(ball, "glb")
    with pytest.raises(ValueError, match="not for obj; leave out"):
        check_variants(ball, "obj")


@pytest.mark.slow
def test_the_gltf_validator_finds_no_fault(variants):
    if not shutil.which("npm") or not shutil.which("node"):
        pytest.skip("node and npm are not installed")
    if not (VALIDATOR / "node_modules" / "gltf-validator").is_dir():
        install = ["npm", "install", "--no-audit", "--no-fund", "--prefix", VALIDATOR, "gltf-validator"]
        if subprocess.run(install, capture_output=True, timeout=120).returncode:
            pytest.skip("gltf-validator cannot be installed: the npm registry is not reached")
    command = ["node", "-e", SCRIPT, str(variants[1])]
    done = subprocess.run(command, cwd=VALIDATOR, capture_output=True, text=True, timeout=60, check=True)
    issues = json.loads(done.stdout)
    assert not issues["numErrors"] and not issues["numWarnings"], issues
