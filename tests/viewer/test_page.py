"""Laws of the viewer's page, read without a browser: whole, bounded, always the same, closed to the net."""

import base64
import hashlib
import io
import json
import re
import zlib
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from helpers.files import colored_ball, obj
from helpers.scene import container, save
from helpers.textured import noise
from PIL import Image

import flx
from flx.assets.asset import Asset, Painting, own_painting
from flx.assets.formats.gltf import Gltf
from flx.assets.read import read_asset
from flx.viewer.page import LIMIT, page, shot

HOSTILE = "</script><script>alert(1)</script><!--\" onload='x' \u2028 \udcff &lt;"
VOID = {"meta", "input", "img", "link", "br"}
ROOT = next(folder for folder in Path(__file__).parents if (folder / "pyproject.toml").exists())


class Tags(HTMLParser):
    """The elements of a page; fails where one is not closed."""

    def __init__(self, content: bytes) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: list[tuple[str, dict[str, str | None]]] = []
        self.texts: dict[str, list[str]] = {}
        self.feed(content.decode())
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.seen.append((tag, dict(attrs)))
        self.open += [tag] if tag not in VOID else []

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open:
            self.texts.setdefault(self.open[-1], []).append(data)


def scripts(content: bytes) -> list[str]:
    """The texts of the script elements: the data, the library and ours."""
    return re.findall(r"<script[^>]*>(.*?)</script>", content.decode(), re.DOTALL)


def data_of(content: bytes) -> dict:
    return json.loads(scripts(content)[0])


def unpacked(text: str, dtype: str, columns: int) -> np.ndarray:
    return np.frombuffer(zlib.decompress(base64.b64decode(text)), dtype).reshape(-1, columns)


@pytest.fixture
def asset(tmp_path) -> Asset:
    return read_asset(obj()(tmp_path))


def paintings(asset: Asset, count: int, size: int = 64) -> list[Painting]:
    return [
        Painting({"base_color": tuple(noise(size, size, n) for _ in asset.textures)}) for n in range(count)
    ]


def test_a_page_holds_the_input_and_every_painting_in_closed_elements(asset):
    shots = [
        shot("input", asset),
        *(shot(f"v {n}", asset, p, f"v_{n}.glb") for n, p in enumerate(paintings(asset, 3))),
    ]
    content = page(
        "tetrahedron", shots, {"seed": 0, "none": None, "off": False, "run": "/home/anna/secret/demo"}
    )
    tags, data = Tags(content), data_of(content)
    assert len(tags.seen) > 30 and "".join(tags.texts["title"]) == "tetrahedron"
    assert [one["name"] for one in data["paintings"]] == ["input", "v 0", "v 1", "v 2"]
    assert [one["file"] for one in data["paintings"]] == ["", "v_0.glb", "v_1.glb", "v_2.glb"]
    assert len(data["meshes"]) == 1 and len(set(data["pictures"])) == 4
    assert data["settings"] == [["seed", "0"], ["run", "demo"]] and b"anna" not in content
    buttons = [attributes for tag, attributes in tags.seen if tag == "button"]
    assert len(buttons) == 7 and all(one["type"] == "button" for one in buttons)


def test_the_same_call_gives_the_same_bytes(asset):
    shots = [shot("input", asset), *(shot("v", asset, one) for one in paintings(asset, 2))]
    assert page("x", shots, {"seed": 0}) == page("x", shots, {"seed": 0})
    assert page("x", shots, {"seed": 1}) != page("x", shots, {"seed": 0})


def test_nothing_in_a_page_names_another_place(asset):
    """Neither an address nor an attribute that loads; and the policy lets only the page's own scripts run."""
    content = page("x", [shot("input", asset)], {})
    addresses = set(re.findall(rb"(?:https?:)?//[\w.-]+\.[a-z]{2,}[^\s\"'`)]*", content))
    assert {one for one in addresses if b"w3.org/1999/xhtml" not in one} == set()  # the name of a namespace
    assert b"@import" not in content and b"url(" not in content
    tags = Tags(content)
    loading = [(tag, name) for tag, attributes in tags.seen for name in attributes if name in ("src", "href")]
    assert loading == []
    policy = next(a["content"] for t, a in tags.seen if t == "meta" and "http-equiv" in a)
    hashes = re.findall(r"'sha256-([\w+/=]+)'", policy or "")
    ours = [base64.b64encode(hashlib.sha256(one.encode()).digest()).decode() for one in scripts(content)[1:]]
    assert hashes == ours and len(ours) == 2
    assert (policy or "").startswith("default-src 'none';") and "http" not in (policy or "")


def test_names_are_text_and_never_markup(asset):
    material = asset._replace(paints=tuple(p._replace(name=HOSTILE) for p in asset.paints))
    shots = [shot("input", material), shot(HOSTILE, material, paintings(asset, 1)[0], HOSTILE)]
    hostile, plain = page(HOSTILE, shots, {HOSTILE: HOSTILE, "n": 1}), page("x", shots[:1], {})
    assert [tag for tag, _ in Tags(hostile).seen] == [tag for tag, _ in Tags(plain).seen]
    data = data_of(hostile)
    assert data["paintings"][1]["name"] == data["paintings"][1]["file"] == HOSTILE
    assert "<" not in scripts(hostile)[0] and b"alert(1)</script>" not in hostile


@pytest.mark.parametrize("limit", [1_000_000, LIMIT])
def test_a_page_is_never_larger_than_its_limit(asset, limit):
    """Noise compresses worst. Fewer bytes are fewer pixels, and what is left out is said."""
    first = [
        shot("input", asset),
        *(shot(f"v{n}", asset, one) for n, one in enumerate(paintings(asset, 6, 1024))),
    ]
    content = page("x", first, {}, limit=limit)
    assert limit / 3 < len(content) <= limit
    wide = max(_width(picture) for picture in data_of(content)["pictures"])
    assert f"at most {wide} pixels" in " ".join(data_of(content)["notes"])
    assert (wide == 1024) == (limit == LIMIT) and len(data_of(content)["paintings"]) == 7


def _width(url: str) -> int:
    return Image.open(io.BytesIO(base64.b64decode(url.split(",")[1]))).width


def test_paintings_that_do_not_fit_are_counted_and_a_mesh_that_does_not_is_refused(asset):
    shots = [
        shot("input", asset),
        *(shot(f"v{n}", asset, one) for n, one in enumerate(paintings(asset, 60, 128))),
    ]
    least = len(page("x", shots[:1], {}))
    content = page("x", shots, {}, limit=least + 150_000)
    shown = len(data_of(content)["paintings"])
    assert 2 <= shown < 61 and len(content) <= least + 150_000
    assert f"{shown - 1} of 60 paintings fit" in " ".join(data_of(content)["notes"])
    with pytest.raises(ValueError, match=r"4 faces are too many for a page of 1 MB"):
        page("x", shots, {}, limit=550_000)


def test_the_page_shows_the_surface_of_the_asset_in_its_colours(tmp_path):
    """Undone: positions, coordinates and colours at each corner are those of the mesh, up to rounding."""
    for asset in (flx.vase(), read_asset(colored_ball(tmp_path))):
        mesh = asset.mesh
        data = data_of(page("x", [shot("input", asset)], {}))
        (drawn,) = data["meshes"]
        faces = unpacked(drawn["faces"], "<u4", 3)
        assert len(faces) == len(mesh.faces) == sum(group["count"] for group in drawn["groups"])
        middle = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
        radius = np.linalg.norm(mesh.vertices - middle, axis=1).max()
        places = unpacked(drawn["positions"], "<u2", 3) / 65535 * drawn["scale"] + drawn["offset"]
        np.testing.assert_allclose(places[faces], (mesh.vertices[mesh.faces] - middle) / radius, atol=2e-5)
        normals = unpacked(drawn["normals"], "i1", 3)[faces] / 127
        flat = np.cross(*np.moveaxis(np.diff(places[faces], axis=1), 1, 0))
        assert np.mean(np.einsum("fkx,fx->fk", normals, flat) > 0) > 0.99
        if mesh.textures:
            np.testing.assert_allclose(unpacked(drawn["uvs"], "<f4", 2)[faces], mesh.corner_uvs, atol=1e-6)
        else:
            colors = unpacked(data["paintings"][0]["colors"], "u1", 3)[faces] / 255
            np.testing.assert_allclose(colors, mesh.corner_colors, atol=0.003)
            assert np.ptp(colors) > 0.5 and drawn["uvs"] is None and data["pictures"] == []


def test_faces_are_grouped_by_what_their_material_looks_like(tmp_path):
    """A tinted material with alpha, one without, and faces of one image in the order of the mesh."""
    gltf = container()
    shift = np.array(
        [[0, 0, 2], [1, 0, 2], [1, 1, 2], [0, 1, 2]], np.float32
    )  # else one part hides the other
    gltf.document["accessors"].append({**gltf.document["accessors"][0], "bufferView": 6})
    gltf.document["meshes"][0]["primitives"][1]["attributes"]["POSITION"] = 3
    gltf.document["bufferViews"].append({"buffer": 0, "byteLength": shift.nbytes})
    asset = read_asset(save(Gltf(gltf.document, (*gltf.views, shift.tobytes())), tmp_path / "a.glb"))
    data = data_of(page("x", [shot("input", asset)], {}))
    (drawn,) = data["meshes"]
    red, green = drawn["groups"]
    assert (red["factor"], red["alpha_mode"], green["factor"], green["alpha_mode"]) == (
        [0.5, 1, 1],
        "BLEND",
        [1, 1, 1],
        "OPAQUE",
    )
    assert [bool(url) for url in drawn["alphas"]] == [True, False]
    uvs = unpacked(drawn["uvs"], "<f4", 2)[unpacked(drawn["faces"], "<u4", 3)]
    for group in (red, green):
        own = asset.mesh.face_textures == group["image"]
        part = uvs[group["start"] : group["start"] + group["count"]]
        np.testing.assert_allclose(part, asset.mesh.corner_uvs[own], atol=1e-6)
        assert len(part) == 2
    colors = [
        np.asarray(Image.open(io.BytesIO(base64.b64decode(u.split(",")[1])))).mean((0, 1))
        for u in data["pictures"]
    ]
    order = [
        int(np.argmax(colors[data["paintings"][0]["pictures"][group["image"]]])) for group in (red, green)
    ]
    assert order == [0, 1]


def test_seams_are_the_edges_where_the_coordinates_part(tmp_path):
    """Each twice, once on either side; a mesh with colours at its vertices has none."""
    asset = flx.vase()
    (drawn,) = data_of(page("x", [shot("input", asset)], {}))["meshes"]
    places, uvs = unpacked(drawn["positions"], "<u2", 3), unpacked(drawn["uvs"], "<f4", 2)
    seams = unpacked(drawn["seams"], "<u4", 2)
    ends = np.sort(places[seams].astype(np.int64) @ [1, 1 << 16, 1 << 32], 1)
    kinds, times = np.unique(ends, axis=0, return_counts=True)
    assert len(kinds) > 100 and (times == 2).all()
    order = np.lexsort(ends.T[::-1])
    first, second = seams[order][::2], seams[order][1::2]
    assert (np.sort(uvs[first], 1) != np.sort(uvs[second], 1)).any((1, 2)).all()
    (ball,) = data_of(page("x", [shot("b", read_asset(colored_ball(tmp_path)))], {}))["meshes"]
    assert len(unpacked(ball["seams"], "<u4", 2)) == 0


def test_alpha_that_a_material_uses_is_in_the_page_once(tmp_path, asset):
    (texture,) = asset.textures
    holes = texture._replace(alpha=np.array([[0, 255], [255, 0]], np.uint8).repeat(2, 0).repeat(2, 1))
    cut = asset._replace(sources={**asset.sources, "base_color": (holes,)})
    masked = cut._replace(paints=tuple(paint._replace(alpha_mode="MASK") for paint in cut.paints))
    for one, modes, known in ((cut, {"OPAQUE"}, False), (masked, {"MASK"}, True)):
        content = page("x", [shot("input", one), *(shot("v", one, p) for p in paintings(one, 2))], {})
        (drawn,) = data_of(content)["meshes"]
        assert {group["alpha_mode"] for group in drawn["groups"]} == modes
        assert [bool(url) for url in drawn["alphas"]] == [known]
        assert content.count(b"data:image/png") == known


def test_paintings_of_another_mesh_stand_beside_the_input(asset):
    vase = flx.vase()
    data = data_of(page("x", [shot("input", vase), shot("v", asset, paintings(asset, 1)[0])], {}))
    assert [one["mesh"] for one in data["paintings"]] == [0, 1] and len(data["meshes"]) == 2


@pytest.mark.parametrize(("name", "most"), [("three", 600_000), ("three-mesh-bvh", 60_000)])
def test_each_library_is_the_one_that_the_credits_name(name, most):
    library = (ROOT / "flx" / "viewer" / f"{name}.min.js").read_bytes()
    assert hashlib.sha256(library).hexdigest() in (ROOT / "docs" / "credits.md").read_text()
    version = json.loads((ROOT / "vendor" / "package.json").read_text())["dependencies"][name]
    first, licence = library.decode().split("\n", 2)[:2]
    assert first == f"/*! {name} {version}" and "MIT License" in licence and len(library) < most


def test_a_notebook_shows_the_page_in_a_frame(asset, tmp_path):
    shown = flx.show(asset, own_painting(asset), up="z", height=300)
    frame = Tags(shown._repr_html_().encode())
    ((tag, attributes),) = frame.seen
    assert tag == "iframe" and attributes["srcdoc"] == shown.content.decode()
    assert attributes["sandbox"] == "allow-scripts" and "height:300px" in str(attributes["style"])
    assert data_of(shown.content)["up"] == "z" and len(repr(shown)) < 50
    shown.save(tmp_path / "viewer.html")
    assert flx.show(tmp_path) == flx.show(tmp_path / "viewer.html", height=640) != shown
    with pytest.raises(ValueError, match=r"viewer.html is not there; flx sample"):
        flx.show(tmp_path / "nowhere" / "viewer.html")
    with pytest.raises(ValueError, match=r"a.obj is no page of flx"):
        flx.show(tmp_path / "a.obj")
    with pytest.raises(ValueError, match="is a page already"):
        flx.show(tmp_path, own_painting(asset))
