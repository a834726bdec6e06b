"""The viewer in Debian's Chromium: what is clicked is seen. Skipped, with a reason, without a browser."""

import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from helpers.browser import NEEDED
from helpers.files import colored_ball
from PIL import Image

import flx
from flx.assets.asset import Asset, Painting, own_painting
from flx.assets.read import read_asset
from flx.geometry.render import render
from flx.viewer.page import page, shot

pytestmark = NEEDED
SIZE = {"width": 900, "height": 640}


@pytest.fixture(scope="module")
def asset() -> Asset:
    return flx.vase()


@pytest.fixture(scope="module")
def folder(asset, tmp_path_factory) -> Path:
    """A page of the vase, in red and in green and in five more tints, beside one of its files."""
    out = tmp_path_factory.mktemp("viewer")
    (image,) = asset.mesh.textures
    small = np.ascontiguousarray(image[::4, ::4])
    tints = [(1, 0.1, 0.1), (0.1, 1, 0.1), *((0.2, 0.2, k / 5) for k in range(5))]
    shots = [shot("input", asset, Painting({"base_color": (small,)}))]
    for n, tint in enumerate(tints):
        painting = Painting({"base_color": ((small * np.array(tint)).astype(np.uint8),)})
        shots.append(shot(f"variation {n:02d}", asset, painting, f"variation_{n:02d}.glb"))
    (out / "viewer.html").write_bytes(page("vase", shots, {"seed": 7, "sampler": "dpm"}))
    flx.save(asset, own_painting(asset), out / "variation_00.glb")
    return out


class Seen:
    """An open page, what it logged and what it asked for."""

    def __init__(self, browser, file: Path, **options) -> None:
        self.page = browser.new_page(viewport=SIZE, color_scheme="light", **options)
        self.faults: list[str] = []
        self.requests: list[str] = []
        self.page.on("console", lambda m: self.faults.append(m.text) if m.type == "error" else None)
        self.page.on("pageerror", lambda error: self.faults.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(file.as_uri())
        self.page.wait_for_selector("html[data-ready]", timeout=120_000)

    def picture(self, selector: str = "#stage") -> np.ndarray:
        self.page.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
        return np.array(
            Image.open(io.BytesIO(self.page.locator(selector).screenshot())).convert("RGB"), float
        )

    def click(self, selector: str) -> None:
        self.page.click(selector)


@pytest.fixture
def seen(browser, folder) -> Iterator[Seen]:
    opened = Seen(browser, folder / "viewer.html")
    yield opened
    opened.page.close()
    assert opened.faults == []
    assert [u for u in opened.requests if not u.startswith(("file:", "data:", "blob:"))] == []
    assert [u for u in opened.requests if u.startswith("file:")] == [(folder / "viewer.html").as_uri()]


def panes(seen: Seen) -> list[np.ndarray]:
    """The picture of each pane."""
    stage = seen.picture()
    corner = seen.page.locator("#stage").bounding_box()
    boxes = [view.bounding_box() for view in seen.page.locator(".view").all()]
    cut = []
    for box in boxes:
        top, left = round(box["y"] - corner["y"]), round(box["x"] - corner["x"])
        cut.append(stage[top : top + int(box["height"]) - 1, left : left + int(box["width"]) - 1])
    return cut


def far(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.abs(one - other).mean())


def test_panes_show_the_input_and_variations_and_thumbnails_exchange_them(seen):
    names = seen.page.locator(".pane p")
    assert seen.page.locator("#choice button").count() == 8 and names.count() == 6
    first, red, green, *_ = panes(seen)
    assert all(one.std() > 10 for one in (first, red, green)), "blank"
    body = slice(len(red) // 3, -len(red) // 3), slice(red.shape[1] * 2 // 5, -red.shape[1] * 2 // 5)
    assert (red[body].mean((0, 1)).argmax(), green[body].mean((0, 1)).argmax()) == (0, 1)
    assert far(red, green) > 5 < far(first, red)
    seen.click("#choice button >> nth=7")  # the oldest but the input gives way
    assert [name.split("\n")[0] for name in names.all_text_contents()][:1] == ["input"]
    shown = " ".join(names.all_text_contents())
    assert "variation 06" in shown and "variation 00" not in shown and names.count() == 6
    seen.click("#choice button >> nth=7")
    assert names.count() == 5 and "5 of 8 shown" in seen.page.inner_text("#status")


def test_all_panes_turn_together_and_keys_do_as_the_mouse(seen):
    before = panes(seen)
    box = seen.page.locator("#canvas").bounding_box()
    seen.page.mouse.move(box["x"] + 100, box["y"] + 100)
    seen.page.mouse.down()
    seen.page.mouse.move(box["x"] + 180, box["y"] + 100, steps=4)
    seen.page.mouse.up()
    turned = panes(seen)
    assert all(far(*pair) > 1 for pair in zip(before, turned, strict=True))
    # One camera: where a pane shows the mesh, each shows it.
    outlines = [np.abs(one - one[0, 0]).max(-1) > 12 for one in turned]
    assert all(np.mean(outlines[0] != outline) < 0.02 for outline in outlines[1:3])
    seen.click("#reset")
    assert all(far(*pair) < 0.1 for pair in zip(before, panes(seen), strict=True))
    seen.page.focus("#canvas")
    seen.page.keyboard.press("ArrowLeft")
    assert far(before[0], panes(seen)[0]) > 1
    seen.page.keyboard.press("0")
    seen.page.mouse.move(box["x"] + 100, box["y"] + 100)
    seen.page.mouse.wheel(0, 300)
    seen.page.wait_for_timeout(300)
    zoomed = panes(seen)[0]
    inner = [one[9:-9, 9:-9] for one in (zoomed, before[0])]  # inside the mark of the focus
    areas = [np.mean(np.abs(one - one[0, 0]).max(-1) > 12) for one in inner]
    assert 0.3 < areas[0] / areas[1] < 0.7


def test_the_line_between_before_and_after_can_be_dragged_and_driven_by_keys(seen):
    seen.click("[data-mode=compare]")
    half = seen.picture()
    box, handle = seen.page.locator("#stage").bounding_box(), seen.page.locator("#handle")
    seen.page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    seen.page.mouse.down()
    seen.page.mouse.move(box["x"] + box["width"] - 2, box["y"] + box["height"] / 2, steps=3)
    seen.page.mouse.up()
    assert int(handle.get_attribute("aria-valuenow") or 0) >= 99
    all_before = seen.picture()
    seen.page.focus("#handle")
    seen.page.keyboard.press("Home")
    all_after = seen.picture()
    middle = half.shape[1] // 2
    left, right = (slice(None), slice(80, middle - 40)), (slice(60, -60), slice(middle + 40, -150))
    assert far(half[left], all_before[left]) < 0.5 < 2 < far(half[left][60:-60], all_after[left][60:-60])
    assert far(half[right], all_after[right]) < 0.5 < 2 < far(half[right], all_before[right])
    seen.page.select_option("#after", label="variation 01")
    assert far(seen.picture(), all_after) > 2
    assert "Right: variation 01" in seen.page.inner_text("#status")


def test_the_mesh_looks_as_in_flx_s_own_pictures(seen, asset):
    """Another renderer, without a graphics card, is the judge; rims and filters of textures may differ."""
    seen.click("[data-mode=compare]")
    seen.page.focus("#handle")
    seen.page.keyboard.press("End")
    shown = seen.picture()[2:-2, 150:-150]
    size = len(seen.picture())
    images = [np.ascontiguousarray(image[::4, ::4]) for image in asset.mesh.textures]
    wanted = render(asset.mesh, images, azimuth=30, elevation=20, size=size).astype(float)[2:-2]
    left = (wanted.shape[1] - shown.shape[1]) // 2
    wanted = (
        wanted[:, left : left + shown.shape[1]]
        if left >= 0
        else np.pad(
            wanted, ((0, 0), (-left, shown.shape[1] - wanted.shape[1] + left), (0, 0)), constant_values=240
        )
    )
    assert far(shown, wanted) < 2.5 < 6 < far(shown, wanted[:, ::-1])


@pytest.mark.parametrize("overlay", ["wireframe", "seams", "unlit"])
def test_overlays_are_seen_and_taken_back(seen, overlay):
    plain = panes(seen)[0]
    seen.click(f"[data-toggle={overlay}]")
    laid = panes(seen)[0]
    assert far(plain, laid) > 0.3
    if overlay == "seams":  # lines of one colour, and nothing else
        changed = np.abs(plain - laid).max(-1) > 30
        assert 0.0005 < changed.mean() < 0.05 and (laid[changed] @ [1, -1, 0] > 30).mean() > 0.8
    seen.click(f"[data-toggle={overlay}]")
    assert far(plain, panes(seen)[0]) < 0.1


def test_the_atlas_is_the_texture_and_its_seams_lie_on_it(seen, asset):
    seen.click("[data-mode=atlas]")
    seen.click("#choice button >> nth=0")
    seen.page.wait_for_selector("#atlas img[alt='Atlas of input']")
    shown = seen.page.locator("#atlas img")
    assert shown.evaluate("image => image.naturalWidth") == len(asset.mesh.textures[0]) // 4
    plain = seen.picture()
    seen.click("[data-toggle=seams]")
    seen.page.wait_for_function("document.querySelector('#atlas canvas').width > 1000")
    seen.page.wait_for_timeout(300)
    changed = np.abs(plain - seen.picture()).max(-1) > 60
    assert 0.0005 < changed.mean() < 0.1


def test_downloads_are_the_files_beside_the_page(seen, folder):
    link = seen.page.locator(".pane a").first
    assert link.get_attribute("aria-label") == "Download variation_00.glb"
    with seen.page.expect_download() as waiting:
        link.click()
    assert Path(waiting.value.path()).read_bytes() == (folder / "variation_00.glb").read_bytes()
    seen.click("summary")
    assert seen.page.locator("#files a").count() == 7
    assert seen.page.inner_text("#settings").split() == ["seed", "7", "sampler", "dpm"]
    seen.requests[:] = [one for one in seen.requests if not one.endswith(".glb")]  # what was clicked


def test_every_button_is_reached_by_the_keyboard(seen):
    reached = set()
    for _ in range(40):
        seen.page.keyboard.press("Tab")
        reached.add(
            seen.page.evaluate("document.activeElement.textContent.trim() || document.activeElement.id")
        )
    wanted = {
        "Side by side",
        "Before / after",
        "Atlas",
        "Wireframe",
        "UV seams",
        "Texture only",
        "Reset view",
    }
    assert wanted | {"canvas", "variation 06", "download"} <= reached
    named = "(one.textContent.trim() || one.ariaLabel)"
    unnamed = f"[...document.querySelectorAll('button, select, a')].filter(one => !{named}).length"
    assert seen.page.evaluate(unnamed) == 0


def test_without_webgl_a_line_says_so_and_the_atlases_are_shown(browser, folder):
    context = browser.new_context()
    context.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    opened = context.new_page()
    opened.goto((folder / "viewer.html").as_uri())
    opened.wait_for_selector("#atlas img")
    assert "no WebGL" in opened.inner_text("#status") and opened.is_disabled("[data-mode=grid]")
    assert opened.locator("#choice img").count() == 8
    context.close()


def test_colours_at_vertices_and_names_with_markup_are_shown(browser, tmp_path):
    ball = read_asset(colored_ball(tmp_path))
    name = "</script><img src=x onerror=alert(1)>"
    other = Painting({}, np.ascontiguousarray(own_painting(ball).colors[:, [1, 2, 0]]))
    shots = [shot("input", ball), shot(name, ball, other, name)]
    (tmp_path / "viewer.html").write_bytes(page(name, shots, {name: name}, up="z"))
    seen = Seen(browser, tmp_path / "viewer.html")
    first, second = panes(seen)
    assert first.std() > 10 < second.std() and far(first, second) > 5
    assert seen.page.inner_text("h1") == name and seen.page.locator("#stage img").count() == 0
    assert seen.page.is_disabled("[data-toggle=seams]") and seen.faults == []
    seen.click("[data-mode=atlas]")
    seen.page.wait_for_selector("text=no atlas")
    seen.page.close()


def test_a_notebook_s_frame_shows_the_same_page(browser, folder):
    (folder / "notebook.html").write_text(f"<!doctype html><body>{flx.show(folder)._repr_html_()}")
    opened = browser.new_page(viewport=SIZE)
    faults: list[str] = []
    opened.on("pageerror", lambda error: faults.append(str(error)))
    opened.goto((folder / "notebook.html").as_uri())
    frame = opened.frame_locator("iframe")
    frame.locator("html[data-ready]").wait_for(timeout=120_000)
    assert frame.locator(".pane").count() == 6 and frame.locator(".pane a").count() == 0
    picture = np.array(Image.open(io.BytesIO(frame.locator("#stage").screenshot())).convert("RGB"), float)
    assert picture.std() > 10 and faults == []
    opened.close()
