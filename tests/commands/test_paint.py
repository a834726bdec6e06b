"""`flx paint`: it serves a page until that has finished, says what to do next, and replaces no other file."""

import http.client
import threading
import time

import pytest
from helpers.files import colored_ball
from helpers.slab import slab
from PIL import Image

from flx.assets.asset import own_painting
from flx.assets.write import write
from flx.launch import main


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("paint")
    write(slab(), own_painting(slab()), made / "slab.glb")
    colored_ball(made)
    Image.new("RGB", (8, 8)).save(made / "there.png")
    return made


def test_a_page_is_served_until_it_has_finished(folder, tmp_path, capfd):
    words = [
        "paint",
        str(folder / "slab.glb"),
        "--direction",
        "--no-browser",
        "--out",
        str(tmp_path / "s.json"),
    ]
    statuses = []
    running = threading.Thread(target=lambda: statuses.append(main(words)), daemon=True)
    running.start()
    said = ""
    for _ in range(600):
        said += capfd.readouterr().err
        if "/\n" in said:
            break
        time.sleep(0.05)
    url = said.split("paint at ")[1].split()[0]
    host, path = url.removeprefix("http://").split("/", 1)

    def ask(method, name, body=None):
        link = http.client.HTTPConnection(host, timeout=30)
        link.request(method, f"/{path}{name}", body, {"Origin": f"http://{host}"})
        return (answer := link.getresponse()).status, answer.read()

    assert b"<canvas" in ask("GET", "")[1] and ask("GET", "data")[0] == 200
    strokes = b'{"strokes": [{"points": [[-0.5, 0, 0.015], [0.5, 0, 0.015]]}]}'
    assert ask("POST", "save", strokes) == (200, b"strokes: 1, with 2 points")
    assert ask("POST", "finish", b"")[0] == 200
    running.join(30)
    out, err = capfd.readouterr()
    assert statuses == [0] and out == f"{tmp_path / 's.json'}\n"
    assert f"next: flx train {folder / 'slab.glb'} --surface.direction {tmp_path / 's.json'}" in err
    with pytest.raises(OSError):
        ask("GET", "")


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (
            ["slab.glb", "--keep", "--direction"],
            "--keep and --direction cannot be painted at once; choose one",
        ),
        (["slab.glb", "--out", "labels.jpg"], "--out is labels.jpg; name a .png file"),
        (["slab.glb", "--direction", "--out", "x.png"], "--out is x.png; name a .json file"),
        (
            ["slab.glb", "--out", "there.png"],
            "there.png is there already; go on with it by --start there.png",
        ),
        (["slab.glb", "--start", "slab.glb", "--out", "there.png"], "there.png is there already"),
        (["slab.glb", "--keep", "--texture-size", "64"], "--texture-size is for labels"),
        (["slab.glb", "--keep", "--start", "there.png"], "has 8 × 8 pixels but the texture 256 × 256"),
        (["slab.glb", "--start", "none.png"], "none.png does not exist"),
        (["slab.glb", "--start", "slab.glb"], "slab.glb"),
        (["slab.glb", "--direction", "--start", "there.png"], "there.png: it is not JSON"),
        (["none.glb"], "none.glb does not exist"),
        (["ball.ply"], "ball.ply has no texture coordinates to paint on"),
        (["ball.ply", "--keep"], "ball.ply has"),
    ],
)
def test_what_cannot_be_painted_is_one_line_and_nothing_is_written(folder, monkeypatch, capsys, words, match):
    monkeypatch.chdir(folder)
    before = {path: path.read_bytes() for path in folder.iterdir()}
    assert main(["paint", "--no-browser", *words]) == 2
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1 and match in said[0]
    assert {path: path.read_bytes() for path in folder.iterdir()} == before
