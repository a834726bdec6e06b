"""Laws of `flx reconstruct`: the same file but for its image, and refused before anything is paid for."""

import pytest
from helpers.cube import changed, saved
from PIL import Image

from flx.commands.reconstruct import Reconstruct, reconstruct

pytestmark = pytest.mark.slow


def test_an_obj_is_reconstructed_as_the_same_obj_and_its_image_keeps_its_alpha(tmp_path, capsys):
    path, out = saved(tmp_path / "in"), tmp_path / "out"
    reconstruct(Reconstruct(path, vertices=60, texture_size=32, out=out, format="obj"))
    stages = [line.split()[0] for line in capsys.readouterr().err.splitlines() if " s so far)" in line]
    assert stages == ["1/4", "2/4", "3/4", "4/4"]
    assert changed(path, out / "reconstruction.obj") == [
        (b"mtllib my cube.mtl\n", b"mtllib reconstruction.mtl\n")
    ]
    assert not (out / "reconstruction.png").exists()
    alpha = Image.open(out / "reconstruction_0.png").getchannel("A")
    assert alpha.size == (32, 16) and alpha.getextrema() == (77, 77)


def test_what_cannot_be_written_is_refused_before_anything_is_paid_for(tmp_path, monkeypatch):
    monkeypatch.setattr("flx.geometry.copies.make_copy", lambda *_: pytest.fail("a copy was made"))
    path = saved(tmp_path / "in")
    with pytest.raises(ValueError, match="has textures, a PLY only vertex colours; use --format"):
        reconstruct(Reconstruct(path, out=tmp_path / "out", format="ply"))
    path = path.rename(path.with_name("reconstruction.obj"))
    with pytest.raises(
        ValueError, match=r"holds the files of another call .reconstruction.obj is there.; name another"
    ):
        reconstruct(Reconstruct(path, out=path.parent, format="obj"))
    assert not (tmp_path / "out").exists()
