"""The painter in Debian's Chromium: what is painted with the mouse is what flx reads.

Skipped, with a reason, without a browser. An oracle in NumPy says where the pointer meets the board.
"""

import re
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from helpers.browser import NEEDED
from helpers.slab import DISC, EXTENTS, SIDE, slab, texel_places
from helpers.surfaces import torus

from flx.assets.arrays import from_arrays
from flx.geometry.seams import seam_corners
from flx.pipeline.direction import read_direction
from flx.pipeline.masks import read_mask
from flx.viewer.painter import Painter, StrokePainter, TexelPainter
from flx.viewer.server import Loopback

pytestmark = NEEDED
VIEW = {"width": 900, "height": 600}
PIXELS = 24  # the radius of the brush at the start
HALF = float(np.linalg.norm(EXTENTS)) / 2


class Seen:
    """An open painter, where its picture is, and what it logged and asked for."""

    def __init__(self, browser, painter: Painter, **options) -> None:
        self.painter = painter
        self.server = Loopback(
            {**painter.answers(), ("POST", "finish"): lambda _: ("text/plain", b"")}, painter.most
        )
        threading.Thread(target=self.server.serve_forever, daemon=True).start()
        self.context = browser.new_context(viewport=VIEW, color_scheme="light", **options)
        self.page = self.context.new_page()
        self.faults: list[str] = []
        self.page.on("console", lambda m: self.faults.append(m.text) if m.type == "error" else None)
        self.page.on("pageerror", lambda error: self.faults.append(str(error)))
        self.page.on(
            "request", lambda r: r.url.startswith((self.server.url, "data:")) or self.faults.append(r.url)
        )
        self.page.goto(self.server.url)
        self.page.wait_for_selector("html[data-ready]", timeout=120_000)
        self.box = self.page.locator("#stage").bounding_box()

    def point(self, x: float, y: float) -> tuple[float, float]:
        """On the screen, of shares of the picture from its middle."""
        return self.box["x"] + self.box["width"] * (0.5 + x), self.box["y"] + self.box["height"] * (0.5 + y)

    def drag(self, *shares: tuple[float, float]) -> None:
        self.page.mouse.move(*self.point(*shares[0]))
        self.page.mouse.down()
        for one in shares[1:]:
            self.page.mouse.move(*self.point(*one), steps=3)
        self.page.mouse.up()

    def click(self, x: float, y: float) -> None:
        self.page.mouse.click(*self.point(x, y))

    def said(self, pattern: str) -> str:
        self.page.locator("#status").filter(has_text=re.compile(pattern)).wait_for()
        return self.page.inner_text("#status")

    def save(self) -> str:
        self.page.click("#save")
        return self.said("^(Saved|Not saved)")

    def numbers(self) -> np.ndarray:
        """The label of each covered texel, as it is saved."""
        self.save()
        return self.painter.drawing.numbers[self.painter.atlas.covered]

    def hit(self, x: float, y: float) -> tuple[np.ndarray, float]:
        """Where the pointer meets the front of the board, and the radius of the brush there."""
        azimuth, elevation, half = np.pi / 6, np.pi / 9, np.radians(12.5)
        towards = np.array(
            [np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)]
        )
        right = np.array([np.cos(azimuth), 0, -np.sin(azimuth)])
        aspect = self.box["width"] / self.box["height"]
        ray = 2 * np.tan(half) * (x * aspect * right - y * np.cross(towards, right)) - towards
        eye = 1.02 / np.sin(half) * towards
        depth = (EXTENTS[2] / 2 / HALF - eye[2]) / ray[2]
        return (eye + depth * ray) * HALF, 2 * depth * np.tan(half) / self.box["height"] * PIXELS * HALF

    def close(self) -> None:
        self.context.close()
        self.server.shutdown()
        self.server.server_close()


@pytest.fixture
def paint(browser, tmp_path) -> Iterator[Callable[..., Seen]]:
    opened: list[Seen] = []

    def made(mode: str, asset=None, size=(SIDE, SIDE), start: Path | None = None, **options) -> Seen:
        asset = asset or slab()
        if mode == "direction":
            painter: Painter = StrokePainter(asset, tmp_path / "strokes.json", start=start)
        else:
            painter = TexelPainter(asset, tmp_path / f"{mode}.png", mode, size, start=start)
        opened.append(Seen(browser, painter, **options))
        return opened[-1]

    yield made
    for one in opened:
        one.close()
        assert one.faults == []


def off_the_way(points: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    along = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    return np.linalg.norm(points - a - along[:, None] * (b - a), axis=1)


def test_a_stroke_goes_on_over_a_seam_and_not_through_the_board(paint):
    seen = paint("labels")
    seen.drag((-0.18, -0.02), (0.16, 0.03))
    there = seen.numbers() == 1
    places, _ = texel_places(slab())
    (start, first), (end, last) = seen.hit(-0.18, -0.02), seen.hit(0.16, 0.03)
    away, front = off_the_way(places, start, end), places[:, 2] > 0.0149
    assert EXTENTS[2] < first < 0.15  # a ball of that radius would reach the back
    assert 500 < there.sum() == (there & front).sum()
    assert away[there].max() < 1.08 * max(first, last)
    assert there[front & (away < 0.9 * min(first, last))].all()
    left, right = places[there][:, 0] < 0, places[there][:, 0] > 0
    assert min(left.sum(), right.sum()) > 200 and len(seam_corners(slab().mesh)) > 0
    # Up to the seam, on both sides of it: no gap of more than two texels.
    for side in (left, right):
        assert np.abs(places[there][side, 0]).min() < 2 * 0.8 / (0.9 * SIDE / 4)
    seen.page.click("#undo")
    seen.click(-0.01, 0.1)  # one dab on the left of it paints the right, too
    middle, radius = seen.hit(-0.01, 0.1)
    inside = front & (np.linalg.norm(places - middle, axis=1) < 0.95 * radius)
    assert middle[0] < 0 and (places[inside][:, 0] > 0).sum() > 20 and (seen.numbers() == 1)[inside].all()


def test_a_brush_at_the_rim_goes_around_it_by_the_length_of_the_way(paint):
    seen = paint("labels", size=(1024, 1024))
    (rim, radius), x = seen.hit(0.1, 0), 0.1
    while rim[0] < 0.78:
        x += 0.002
        rim, radius = seen.hit(x, 0)
    seen.click(x, 0)
    places, _ = texel_places(slab(), 1024)
    back = (seen.numbers() == 1) & (places[:, 2] < -0.0149)
    reach = radius - (0.8 - rim[0]) - EXTENTS[2]  # that is left of the radius on the back
    assert reach > 0.03 and abs(0.8 - places[back][:, 0].min() - reach) < 0.012


def test_undo_and_redo_are_exact_and_the_eraser_takes_paint_away(paint):
    seen = paint("labels")
    empty = seen.numbers()
    seen.drag((-0.1, 0), (0.1, 0))
    one = seen.numbers()
    seen.page.click("#add")
    seen.page.keyboard.press("Enter")
    seen.drag((0, -0.1), (0, 0.1))
    two = seen.numbers()
    assert (two == 2).sum() > 200 < (one == 1).sum() and empty.max() == 0
    seen.page.focus("#canvas")
    seen.page.keyboard.press("Control+z")
    assert (seen.numbers() == one).all()
    seen.page.click("#undo")
    assert (seen.numbers() == empty).all() and seen.page.is_disabled("#undo")
    seen.page.keyboard.press("Control+y")
    seen.page.click("#redo")
    assert (seen.numbers() == two).all() and seen.page.is_disabled("#redo")
    seen.page.keyboard.press("x")
    seen.page.keyboard.press("]")
    seen.drag((-0.15, 0), (0.15, 0))
    erased = seen.numbers()
    assert (erased == 1).sum() == 0 < (erased == 2).sum() < (two == 2).sum()


def test_fills_follow_charts_parts_and_colours(paint):
    seen = paint("labels")
    places, atlas = texel_places(slab())
    front = places[:, 2] > 0.01499
    seen.page.click("[data-tool=similar]")
    seen.click(0.02, 0)
    seen.said("^Filled [1-9]")
    disc = (slab().mesh.textures[0][atlas.covered] == DISC).all(1)
    assert ((seen.numbers() == 1) == disc).all() and disc.sum() > 500
    seen.page.click("#undo")
    seen.page.click("[data-tool=chart]")
    seen.click(0.1, 0)
    chart = seen.numbers() == 1
    assert (chart == (front & (places[:, 0] > 0)))[np.abs(places[:, 0]) > 0.02].all()
    seen.page.click("[data-tool=part]")
    seen.click(-0.1, 0)
    assert (seen.numbers() == 1).all()


def test_mirrored_strokes_are_mirror_images(paint):
    seen = paint("labels")
    seen.page.select_option("#mirror", label="y")
    seen.drag((-0.15, -0.12), (0.05, -0.1))
    there = (seen.numbers() == 1).astype(int)
    places, _ = texel_places(slab())
    front = places[:, 2] > 0.0149
    halves = [
        np.histogram2d(*(places[front & (there > 0)] * (1, flip, 1)).T[:2], 8, ((-0.8, 0.8), (-0.5, 0.5)))[0]
        for flip in (1, -1)
    ]
    assert halves[0].sum() > 500 and np.abs(halves[0] - halves[1]).sum() < 0.12 * halves[0].sum()
    assert there[front & (places[:, 1] > 0.02)].sum() > 200 < there[front & (places[:, 1] < -0.02)].sum()


def test_names_and_colours_of_labels_are_saved_and_one_with_markup_is_text(paint):
    seen = paint("labels")
    seen.page.fill("#labels li:nth-child(2) .name", "<b>petals & stem")
    seen.page.locator("#labels li:nth-child(2) input[type=color]").fill("#123456")
    seen.drag((-0.1, 0), (0.1, 0))
    assert "<b>petals & stem" in seen.save()
    assert seen.painter.drawing.labels[1] == ("<b>petals & stem", "#123456")
    again = paint("labels", start=seen.painter.out)
    assert again.page.input_value("#labels li:nth-child(2) .name") == "<b>petals & stem"
    assert (again.numbers() == seen.numbers()).all()


def test_a_mask_is_what_is_painted(paint):
    seen = paint("keep")
    seen.drag((-0.18, -0.02), (0.16, 0.03))
    painted = seen.numbers() == 1
    mask = read_mask(seen.painter.out, (SIDE, SIDE))
    assert (mask[seen.painter.atlas.covered] == painted).all() and painted.sum() > 500
    assert seen.page.is_hidden("#add") and "keep" in seen.page.inner_text("#labels")


def test_strokes_lie_on_the_surface_the_way_they_were_drawn(paint):
    seen = paint("direction")
    seen.drag((-0.18, -0.02), (0.16, 0.03))
    seen.drag((0.16, 0.1), (-0.1, 0.1))
    assert "strokes: 2" in seen.save()
    first, second = read_direction(str(seen.painter.out), slab())
    for stroke, way in ((first, ((-0.18, -0.02), (0.16, 0.03))), (second, ((0.16, 0.1), (-0.1, 0.1)))):
        start, end = (seen.hit(*one)[0] for one in way)
        assert len(stroke.points) > 20 and off_the_way(stroke.points, start, end).max() < 0.01
        assert (
            np.linalg.norm(stroke.points[0] - start) < 0.01 > np.linalg.norm(stroke.points[-1] - end) - 0.02
        )
    seen.page.keyboard.press("x")
    seen.drag((0, 0.08), (0, 0.12))
    assert "strokes: 1" in seen.save()
    seen.page.click("#undo")
    assert "strokes: 2" in seen.save()
    assert seen.page.is_hidden("[data-tool=chart]") and seen.page.is_hidden("#labels")
    again = paint("direction", start=seen.painter.out)
    before = seen.painter.out.read_bytes()
    assert "strokes: 2" in again.save() and again.painter.out.read_bytes() == before


def test_what_flx_refuses_is_said_and_nothing_is_lost(paint):
    seen = paint("direction")
    seen.faults.clear()
    assert "Not saved" in seen.save() and "has no strokes" in seen.page.inner_text("#status")
    assert not seen.painter.out.exists()
    assert [fault for fault in seen.faults if "400" not in fault] == []  # the browser logs the answer
    seen.faults.clear()


def test_a_finger_paints_and_two_fingers_turn_and_zoom(paint):
    seen = paint("labels", has_touch=True)
    send = seen.context.new_cdp_session(seen.page).send

    def touch(kind: str, *shares: tuple[float, float]) -> None:
        points = [dict(zip("xy", seen.point(*one), strict=True), id=n) for n, one in enumerate(shares)]
        send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    touch("touchStart", (-0.1, 0))
    for k in range(6):
        touch("touchMove", (-0.1 + 0.04 * k, 0))
    touch("touchEnd")
    there = seen.numbers() == 1
    assert there.sum() > 300
    touch("touchStart", (-0.1, 0.1))
    touch("touchMove", (-0.08, 0.1))
    touch("touchStart", (-0.08, 0.1), (0.1, 0.1))
    for k in range(6):
        touch("touchMove", (-0.08 - 0.02 * k, 0.1), (0.1 + 0.02 * k, 0.1))
    touch("touchEnd")
    assert ((seen.numbers() == 1) == there).all()
    seen.page.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")


def test_everything_is_named_and_reached_by_the_keyboard_and_space_paints(paint):
    seen = paint("labels")
    reached = set()
    for _ in range(40):
        seen.page.keyboard.press("Tab")
        reached.add(
            seen.page.evaluate("document.activeElement.id || document.activeElement.textContent.trim()")
        )
    assert {
        "Brush",
        "Fill UV island",
        "canvas",
        "size",
        "mirror",
        "opacity",
        "save",
        "finish",
        "add",
    } <= reached
    named = "(one.textContent.trim() || one.ariaLabel || one.labels?.length)"
    assert (
        seen.page.evaluate(
            f"[...document.querySelectorAll('button, select, input')].filter(one => !{named}).length"
        )
        == 0
    )
    seen.page.focus("#canvas")
    before = seen.numbers()
    seen.page.focus("#canvas")
    seen.page.keyboard.press(" ")
    assert before.max() == 0 < (seen.numbers() == 1).sum()


def test_save_and_finish_ends_the_page(paint):
    seen = paint("labels")
    seen.drag((-0.1, 0), (0.1, 0))
    seen.page.click("#finish")
    assert "can be closed" in seen.said("finished") and seen.painter.saved
    assert seen.page.is_disabled("#save") and seen.page.is_disabled("#undo")


def test_a_hundred_thousand_faces_take_thirty_dabs_a_second(paint, record_property):
    """Drawn without a graphics card: from the first dab to the picture after the last."""
    n = 224
    ring = torus(n, n)
    u, v = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
    faces = ring.faces
    rows, columns = faces // n, faces % n
    for place in (rows, columns):
        place[(np.ptp(place, axis=1) > 1)[:, None] & (place == 0)] = n
    uvs = 0.01 + 0.98 * np.stack([u[rows, columns], v[rows, columns]], -1) / n
    asset = from_arrays(*ring, uvs, np.full((2048, 2048, 3), 180, np.uint8))
    seen = paint("labels", asset, (2048, 2048))
    seen.drag((-0.1, 0.25), (-0.05, 0.25))  # programs of the graphics are made at their first use
    seen.page.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    x, y = seen.point(-0.2, 0.25)
    seen.page.mouse.move(x, y)
    seen.page.mouse.down()
    start = time.perf_counter()
    for k in range(1, 21):  # dabs are a quarter of the brush apart: three for each step of the mouse
        seen.page.mouse.move(x + 3 * k * PIXELS / 4 + 0.01, y)
    seen.page.mouse.up()
    seen.page.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    rate = 60 / (time.perf_counter() - start)
    record_property("dabs a second", rate)
    print(f"{asset.report.faces:,} faces, 2048² texels: {rate:.0f} dabs a second")
    assert re.match("[12]..,...$", f"{asset.report.faces:,}") and rate >= 30
