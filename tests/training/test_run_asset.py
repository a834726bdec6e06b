"""Laws of a run's own copy of its asset: read there it has the same bits, wherever the original goes."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.cube import CUBE, colored, saved
from helpers.files import PLY, document, glb, png
from PIL import Image

from flx.assets.asset import Asset, Painting
from flx.assets.formats.obj_source import ObjSource
from flx.assets.write import write
from flx.config import Surface
from flx.training.run import Run
from flx.training.run_asset import direction_in, fill_in, keep, read_copy, read_source, source_of


def obj(folder: Path) -> Path:
    return saved(folder)


def obj_without_mtl(folder: Path) -> Path:
    return saved(folder, CUBE.replace("usemtl wood\n", "", 1).replace("my cube", "gone"))


def obj_colors(folder: Path) -> Path:
    return saved(folder, colored(255), "newmtl wood\nmap_Bump textures/bump.png\n")


def ply_image(folder: Path) -> Path:
    text = PLY.replace("format ascii 1.0", "format ascii 1.0\ncomment TextureFile t/t.png")
    text = (
        text.replace("uchar red", "float s").replace("uchar green", "float t").replace("float x", "double x")
    )
    text = text.replace("0 0 0 255 0 0", "0.1 0 0 255 0 0")  # no float32
    (folder / "t").mkdir(parents=True)
    (folder / "t" / "t.png").write_bytes(png())
    (folder / "a.ply").write_text(text.replace("255", "1").replace("199", "0").replace("99", "0.5"))
    return folder / "a.ply"


def ply_colors(folder: Path) -> Path:
    folder.mkdir()
    (folder / "a.ply").write_text(PLY)
    return folder / "a.ply"


def glb_file(folder: Path) -> Path:
    folder.mkdir()
    (folder / "asset.glb").write_bytes(glb(*document()))
    return folder / "asset.glb"


def gltf_files(folder: Path) -> Path:
    import json

    described, content = document()
    described["buffers"][0]["uri"] = "a.bin"
    described["images"] = [{"uri": "sub/b%20c.png"}]
    (folder / "sub").mkdir(parents=True)
    (folder / "sub" / "b c.png").write_bytes(png())
    (folder / "a.bin").write_bytes(content)
    (folder / "a.gltf").write_text(json.dumps(described))
    return folder / "a.gltf"


def same_bits(a: Asset, b: Asset) -> bool:
    paints = [[paint for paint in asset.paints] for asset in (a, b)]
    return (
        a.digest == b.digest
        and paints[0] == paints[1]
        and all(
            np.array_equal(x, y)
            for p, q in zip(a.parts, b.parts, strict=True)
            for x, y in ((p.positions, q.positions), (p.faces, q.faces), (p.uvs, q.uvs), (p.colors, q.colors))
            if x is not None or y is not None
        )
    )


GIVEN = [obj, obj_without_mtl, ply_image, glb_file, gltf_files]


@pytest.mark.parametrize(
    "make, given",
    [(make, False) for make in (obj, obj_colors, ply_image, ply_colors, glb_file, gltf_files)]
    + [(make, True) for make in GIVEN],
)
def test_an_asset_is_read_back_from_its_run_bit_for_bit(tmp_path, make, given):
    texture = tmp_path / "given.png"
    Image.effect_noise((7, 5), 90).convert("RGB").save(texture)
    surface = Surface(path=str(make(tmp_path / "in")), texture=str(texture) if given else None)
    run, asset = Run(tmp_path / "run"), read_source(surface)
    kept = keep(asset, run, surface)
    shutil.rmtree(tmp_path / "in")
    texture.unlink()
    again = read_copy(run, surface)
    assert same_bits(asset, kept) and same_bits(asset, again)
    assert run.asset in again.path.parents
    files = {path: path.stat().st_mtime_ns for path in run.asset.rglob("*")}
    assert same_bits(asset, keep(asset, run, surface))  # a second call writes nothing
    assert files == {path: path.stat().st_mtime_ns for path in run.asset.rglob("*")}


def test_an_obj_comes_out_of_its_run_as_it_came_in(tmp_path):
    surface = Surface(path=str(saved(tmp_path / "in", end="\r\n")))
    asset = keep(read_source(surface), Run(tmp_path / "run"), surface)
    assert isinstance(asset.container, ObjSource)
    (tmp_path / "out").mkdir()
    write(asset, Painting({"base_color": asset.mesh.textures}), tmp_path / "out" / "cube.obj")
    before, after = (folder / "cube.obj" for folder in (tmp_path / "in", tmp_path / "out"))
    assert after.read_bytes() == before.read_bytes().replace(b"my cube.mtl", b"cube.mtl", 1)
    maps = {path.name for path in (tmp_path / "out" / "textures").iterdir()}
    assert maps == {"wood grain.png", "bump.png", "normal.tga", "unused.jpg"}


def test_the_vase_is_kept(tmp_path):
    asset = read_source(Surface())
    assert same_bits(asset, keep(asset, Run(tmp_path), Surface()))


def test_a_run_that_kept_its_asset_as_one_glb_still_opens(tmp_path):
    """As older versions wrote it: float32, the given texture in the place of the file's own."""
    (tmp_path / "run" / "asset").mkdir(parents=True)
    for make, given in ((obj, "given.png"), (ply_colors, None)):
        Image.new("RGB", (4, 4), (1, 2, 3)).save(tmp_path / "given.png")
        path = make(tmp_path / make.__name__)
        surface = Surface(path=str(path), texture=str(tmp_path / given) if given else None)
        asset, old = read_source(surface), tmp_path / "run" / "asset" / "asset.glb"
        if asset.textures:
            write(asset, Painting({"base_color": asset.mesh.textures}), old)
        else:
            write(asset, Painting({}, asset.parts[0].colors), old)
        (tmp_path / "given.png").unlink()
        kept = keep(asset, Run(tmp_path / "run"), surface)
        assert kept.path == old and list(old.parent.iterdir()) == [old]
        assert len(kept.mesh.faces) == len(asset.mesh.faces)
        assert not given or (kept.mesh.textures[0] == [1, 2, 3]).all()


def test_a_copy_that_was_killed_is_made_again(tmp_path, monkeypatch):
    surface, run = Surface(path=str(saved(tmp_path / "in"))), Run(tmp_path / "run")
    asset = read_source(surface)
    with monkeypatch.context() as patch:
        # Maps and MTL are there, the OBJ is not.
        patch.setattr("flx.assets.formats.obj_source._naming", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            keep(asset, run, surface)
    assert (run.asset / "files" / "cube.mtl").exists()
    assert same_bits(asset, keep(asset, run, surface))


def test_strokes_are_kept_with_the_mesh_and_a_word_is_itself(tmp_path):
    strokes = tmp_path / "s.json"
    strokes.write_text('{"strokes": [{"points": [[0, 0, 0], [1, 0, 0]]}]}')
    path = str(ply_colors(tmp_path / "mesh"))
    drawn, worded = (Surface(path=path, direction=said) for said in (str(strokes), "y"))
    for run, surface in ((Run(tmp_path / "a"), drawn), (Run(tmp_path / "b"), worded)):
        keep(read_source(surface), run, surface)
    written = strokes.read_bytes()
    strokes.unlink()
    kept = Path(direction_in(Run(tmp_path / "a"), drawn))
    assert kept.is_relative_to(tmp_path / "a") and kept.read_bytes() == written
    assert direction_in(Run(tmp_path / "b"), worded) == "y" and not (tmp_path / "b/asset/direction").exists()
    assert direction_in(Run(tmp_path / "b"), Surface(path=path)) == ""


def test_a_mask_of_damage_is_kept_with_the_mesh(tmp_path):
    Image.new("L", (4, 4)).save(tmp_path / "mask.png")
    path = str(glb_file(tmp_path / "mesh"))
    run, surface = Run(tmp_path / "run"), Surface(path=path, fill=str(tmp_path / "mask.png"))
    asset = keep(read_source(surface), run, surface)
    source = source_of(run, surface, asset)
    assert source.fill == "fill/mask.png"
    assert source.files[source.fill] == (tmp_path / "mask.png").read_bytes()
    assert fill_in(run, surface).exists() and source_of(run, Surface(path=path), asset).fill is None


@pytest.mark.parametrize(
    "damage", [lambda content: content[:-9], lambda content: content.replace(b"99", b"98", 1)]
)
def test_a_damaged_copy_is_made_again_with_a_word(tmp_path, capsys, damage):
    surface, run = Surface(path=str(ply_colors(tmp_path / "own"))), Run(tmp_path / "run")
    asset = read_source(surface)
    copy = keep(asset, run, surface)
    assert not capsys.readouterr().err and keep(asset, run, surface).digest == asset.digest
    before = copy.path.read_bytes()
    copy.path.write_bytes(damage(before))
    assert keep(asset, run, surface).digest == asset.digest and copy.path.read_bytes() == before
    told = capsys.readouterr().err
    assert told == f"{copy.path} is not what was copied there; it is copied again\n"
