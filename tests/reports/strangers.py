# ruff: noqa: E501  (the table of cases: one line each)
"""What strangers may hand to the verbs besides meshes, and the line that answers each: masks, labels, runs edited
by hand, generators, weights, folders of images, options, and requests to the painter's page.

python tests/reports/strangers.py prints the table: status, line, CPU seconds, peak memory.
"""

import base64
import contextlib
import http.client
import io
import json
import os
import re
import resource
import shutil
import signal
import sys
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import jax
import numpy as np
from PIL import Image

sys.path.append(str(Path(__file__).parents[1]))  # a script finds what lies beside it, not helpers
from helpers.files import obj, png, png_bomb
from helpers.generators import colored_sphere, labelled_sphere
from helpers.surfaces import icosphere
from reports.measure import forget_peak, peak_megabytes

import flx.pipeline.generator
from flx.assets.read import read_asset
from flx.config import FLDM, FLDMExperiment, Surface
from flx.fields.diffusion import Scaling
from flx.geometry.tables import mesh_tables
from flx.launch import main
from flx.models.denoiser.depth import complete
from flx.pipeline.codec import load_codec
from flx.pipeline.generator import Generator, Home, Source, learnt_generator, parameter_shapes, save_generator
from flx.pipeline.labels import Labels
from flx.pipeline.tensors import load_tensors, save_tensors
from flx.pipeline.weights import RELEASED
from flx.training.run import open_run
from flx.types import Triangulation
from flx.viewer.painter import StrokePainter, TexelPainter
from flx.viewer.server import serving

Make = Callable[[Path], object]  # makes what is hostile in a folder that holds what is good


class Case(NamedTuple):
    name: str
    words: str  # the command, in a folder with a.obj, ball.ply, g.safetensors, labelled.safetensors and run/
    match: str  # what its line says
    make: Make = lambda _: None


class Request(NamedTuple):
    name: str
    body: bytes
    match: str
    mode: str = "labels"
    headers: tuple[tuple[str, str], ...] = ()
    answer: str = "save"


class Outcome(NamedTuple):
    status: int
    lines: list[str]  # of stderr, or of the answer to a request
    seconds: float  # CPU
    megabytes: float  # most memory in use
    written: list[str]


def put(name: str, content: bytes | str) -> Make:
    def write(folder: Path) -> None:
        place = folder / name
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(content if isinstance(content, bytes) else content.encode())

    return write


def instead(name: str, make: Make) -> Make:
    """Something else in the place of a file."""

    def replace(folder: Path) -> None:
        (folder / name).unlink(missing_ok=True)
        make(folder / name)

    return replace


def sparse(path: Path) -> None:
    with open(path, "wb") as file:
        file.truncate(20 << 30)


def picture(width: int, height: int, mode: str = "RGB", kind: str = "PNG", value: Any = 0) -> bytes:
    content = io.BytesIO()
    Image.new(mode, (width, height), value).save(content, kind)
    return content.getvalue()


def config(**changes: Any) -> Make:
    """The record of the run with other values; `a__b` is a place in it."""

    def edit(folder: Path) -> None:
        path = folder / "run" / "config.json"
        record = json.loads(path.read_text())
        for place, value in changes.items():
            *inner, last = place.split("__")
            holder = record
            for key in inner:
                holder = holder[key]
            holder[last] = value
        path.write_text(json.dumps(record))

    return edit


def written(content: bytes | str) -> Make:
    return put("run/config.json", content)


def tensors(change: Callable[[dict[str, np.ndarray]], object], edit: Callable[[dict], object] = len) -> Make:
    """g.safetensors by a stranger who knows how: with a right digest of other arrays, or another record."""

    def craft(folder: Path) -> None:
        text, arrays = load_tensors(folder / "g.safetensors", "generator")
        record = json.loads(text)
        change(arrays), edit(record)
        save_tensors(folder / "g.safetensors", arrays, "generator", json.dumps(record))

    return craft


def weights(edit: Callable[[dict], object], change: Callable[[dict], object] = len) -> Make:
    def craft(folder: Path) -> None:
        text, arrays = load_tensors(RELEASED, "flvae")
        record = json.loads(text)
        edit(record), change(arrays)
        save_tensors(folder / "w.safetensors", arrays, "flvae", json.dumps(record))

    return craft


def flipped(name: str) -> Make:
    def flip(folder: Path) -> None:
        content = bytearray((folder / name).read_bytes())
        content[len(content) // 2] ^= 1
        (folder / name).write_bytes(content)

    return flip


def cut(name: str, share: float = 0.5) -> Make:
    def shorten(folder: Path) -> None:
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(content[: int(share * len(content))])

    return shorten


def set_first(name: str, value: float) -> Callable[[dict[str, np.ndarray]], None]:
    def change(arrays: dict[str, np.ndarray]) -> None:
        key = next(key for key in arrays if key.startswith(name))
        array = arrays[key] = arrays[key].copy()
        array.reshape(-1)[0] = value

    return change


def moved_sphere() -> bytes:
    sphere = icosphere(2)
    return labelled_sphere(Triangulation(sphere.vertices + np.array([5.0, 0, 0]), sphere.faces))


PS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n"
KEEP = "sample a.obj --instant --keep m.png --out new"
FILL = "sample a.obj --instant --fill m.png --out new"
RUN = "sample run --count 1 --invention 1 --steps 1 --out new"
FILE = "sample g.safetensors --count 1 --invention 1 --steps 1 --out new"
LABELLED = "sample labelled.safetensors --count 1 --invention 1 --steps 1 --out new --labels l.ply"
LEARN = "train a.obj --surface.vertices 100 --surface.copies 1 --workers 1 --train.steps 1"
IMAGES = f"train {Path(__file__).parents[2] / 'experiments' / 'flvae.py'} --images.folder pictures"
WEIGHTS = "reconstruct ball.ply --vertices 100 --weights w.safetensors --out new"

CASES = [
    # masks
    Case("mask: another size", KEEP, "5 × 5.*4 × 4", put("m.png", picture(5, 5))),
    Case("mask: turned", KEEP, "4", put("m.png", picture(8, 2))),
    Case("mask: one pixel", FILL, "1 × 1", put("m.png", picture(1, 1))),
    Case("mask: cut off", KEEP, "broken", put("m.png", png(64, 64)[:2000])),
    Case("mask: a text", KEEP, "no known kind", put("m.png", "white")),
    Case("mask: empty", FILL, "no known kind", put("m.png", b"")),
    Case("mask: missing", KEEP, "m.png"),
    Case("mask: a folder", KEEP, "m.png", instead("m.png", os.mkdir)),
    Case("mask: a pipe", KEEP, "m.png", instead("m.png", os.mkfifo)),
    Case("mask: a device", FILL, "m.png", instead("m.png", lambda path: path.symlink_to("/dev/zero"))),
    Case("mask: 20 GB", KEEP, "FLX_MAX_BYTES", instead("m.png", sparse)),
    Case("mask: 20,000 × 20,000", FILL, "pixels", put("m.png", png_bomb(20000, 20000))),
    Case("mask: PostScript", KEEP, "no known kind", put("m.png", PS)),
    Case("mask: floating point", KEEP, "floating point", put("m.png", picture(4, 4, "F", "TIFF"))),
    Case("mask: KTX2", FILL, "KTX", put("m.png", b"\xabKTX 20\xbb\r\n\x1a\n")),
    Case("mask: keep and fill", f"{KEEP} --fill m.png", "keep.*fill", put("m.png", picture(4, 4))),
    Case("mask: of a mesh without a texture", "sample ball.ply --instant --keep m.png --out new", "0 textures", put("m.png", picture(4, 4))),
    # labels
    Case("labels: missing", LABELLED, "do not exist"),
    Case("labels: never learnt", LABELLED, "learn", put("l.ply", labelled_sphere().replace(b" 200 0 0\n", b" 9 99 199\n"))),
    Case("labels: a smooth painting", LABELLED, "labels l.ply", put("l.ply", colored_sphere())),
    Case("labels: elsewhere", LABELLED, "lies elsewhere", put("l.ply", moved_sphere())),
    Case("labels: empty", LABELLED, "is empty", put("l.ply", b"")),
    Case("labels: cut off", LABELLED, "cut off|too short", put("l.ply", labelled_sphere()[:-400])),
    Case("labels: an OBJ", LABELLED.replace("l.ply", "a.obj"), "other files"),
    Case("labels: an image without coordinates", LABELLED.replace("l.ply", "m.png"), "no texture coordinates", put("m.png", picture(4, 4))),
    Case("labels: NaN", LABELLED, "not finite", put("l.ply", re.sub(rb"\n-0\.\d+ ", b"\nnan ", labelled_sphere(), count=1))),
    Case("labels: of a run without", f"{FILE} --labels ball.ply", "learnt no labels"),
    Case("guidance: of a run without", f"{FILE} --guidance 2", "learnt no labels"),
    Case("guidance: NaN", f"{LABELLED.rsplit(' --labels', 1)[0]} --guidance nan", "guidance"),
    Case("guidance: -1", f"{LABELLED.rsplit(' --labels', 1)[0]} --guidance -1", "guidance"),
    Case("labels to learn: one colour", f"{LEARN} --surface.labels m.png", "labels m.png", put("m.png", picture(4, 4))),
    Case("labels to learn: a photograph", f"{LEARN} --surface.labels m.png", "labels m.png", put("m.png", png(64, 64))),
    Case("labels to learn: missing", f"{LEARN} --surface.labels m.png", "do not exist"),
    Case("labels to learn: PostScript", f"{LEARN} --surface.labels m.png", "no known kind", put("m.png", PS)),
    Case("labels to learn: a folder", f"{LEARN} --surface.labels m.png", "m.png", instead("m.png", os.mkdir)),
    Case("direction: a word", f"{FILE} --direction upwards", "direction"),
    Case("direction: of a run without", f"{FILE} --direction z", "direction"),
    Case("rotate: infinity", f"{FILE} --direction z --rotate inf", "rotate"),
    # run folders edited by hand
    Case("run: not there", "sample nowhere", "does not exist"),
    Case("run: an empty folder", "sample empty", "no config.json", lambda folder: (folder / "empty").mkdir()),
    Case("run: record empty", RUN, "does not record a run", written("")),
    Case("run: record not JSON", RUN, "does not record a run", written("{")),
    Case("run: 200,000 brackets", RUN, "does not record a run", written("[" * 200_000)),
    Case("run: a list", RUN, "does not record a run", written("[]")),
    Case("run: Latin-1", RUN, "does not record a run", written(b'{"kind": "\xfc"}')),
    Case("run: an integer of 10,000 digits", RUN, "does not record a run", written('{"kind":' + "9" * 10_000 + "}")),
    Case("run: record of 20 GB", RUN, "FLX_MAX_BYTES", instead("run/config.json", sparse)),
    Case("run: record is a pipe", RUN, "config.json", instead("run/config.json", os.mkfifo)),
    Case("run: record is a folder", RUN, "config.json", instead("run/config.json", os.mkdir)),
    Case("run: record is a link", RUN, "is a link", instead("run/config.json", lambda path: path.symlink_to("/etc/hosts"))),
    Case("run: another kind", RUN, "does not record a run", config(kind="Pickle")),
    Case("run: of an FL-VAE", RUN, "config", config(kind="FLVAEExperiment")),
    Case("run: fingerprint 1", RUN, "does not record a run", config(fingerprint=1)),
    Case("run: config null", RUN, "does not record a run", config(config=None)),
    Case("run: no model", RUN, "config.model", config(config__model=None)),
    Case("run: -5 vertices", RUN, "surface.vertices is -5", config(config__surface__vertices=-5)),
    Case("run: many vertices", RUN, "surface.vertices is 'many'", config(config__surface__vertices="many")),
    Case("run: an unknown field", RUN, "unknown field 'width'", config(config__surface__width=3)),
    Case("run: 10^9 channels", RUN, "model.channels is 1000000000", config(config__model__channels=10**9)),
    Case("run: no blocks at a level", RUN, "model.blocks", config(config__model__blocks=[1, 0, 1])),
    Case("run: 10^6 blocks", RUN, "model.blocks", config(config__model__blocks=[1, 10**6, 1])),
    Case("run: embedding 3", RUN, "model.embedding is 3", config(config__model__embedding=3)),
    Case("run: a learning rate of NaN", RUN, "learning_rate is nan", config(config__train__learning_rate=float("nan"))),
    Case("run: a mesh that is a number", RUN, "surface.path", config(config__surface__path=7)),
    Case("run: neither generator nor checkpoint", RUN, "ball.ply|checkpoint", instead("run/generator.safetensors", str)),
    Case("run: generator cut off", RUN, "generator.safetensors cannot be used", cut("run/generator.safetensors")),
    Case("run: generator is a link", RUN, "is a link", instead("run/generator.safetensors", lambda path: path.symlink_to("../g.safetensors"))),
    # generator files
    Case("generator: missing", FILE, "does not exist", instead("g.safetensors", str)),
    Case("generator: empty", FILE, "cannot be used as a generator", put("g.safetensors", b"")),
    Case("generator: a text", FILE, "cannot be used as a generator", put("g.safetensors", "a generator")),
    Case("generator: cut off", FILE, "cannot be used as a generator", cut("g.safetensors", 0.9)),
    Case("generator: a flipped bit", FILE, "not what was written", flipped("g.safetensors")),
    Case("generator: a pickle", FILE, "cannot be used as a generator", put("g.safetensors", b"\x80\x04cos\nsystem\n(S'touch new'\ntR.")),
    Case("generator: a header of 2^60 bytes", FILE, "cannot be used as a generator", put("g.safetensors", (1 << 60).to_bytes(8, "little") + b"{}")),
    Case("generator: weights", f"sample {RELEASED} --out new", "cannot be used as a generator"),
    Case("generator: a pipe", FILE, "g.safetensors", instead("g.safetensors", os.mkfifo)),
    Case("generator: 20 GB", FILE, "g.safetensors", instead("g.safetensors", sparse)),
    Case("generator: weights of NaN", FILE, "not finite", tensors(set_first("network/", np.nan))),
    Case("generator: codec of infinity", FILE, "not finite", tensors(set_first("codec/", np.inf))),
    Case("generator: scaling of 0", FILE, "scaling", tensors(lambda t: t["scaling"].fill(0))),
    Case("generator: a vertex of NaN", FILE, "not finite", tensors(set_first("home/vertices", np.nan))),
    Case("generator: a face of vertex 9999", FILE, "not there", tensors(set_first("home/faces", 9999))),
    Case("generator: no faces", FILE, "not there", tensors(lambda t: t.update({"home/faces": t["home/faces"][:0]}))),
    Case("generator: half of the faces", FILE, "cannot be used|connected|vertex", tensors(lambda t: t.update({"home/faces": t["home/faces"][::2].copy()}))),
    Case("generator: no network", FILE, "differs", tensors(lambda t: [t.pop(k) for k in [*t] if k.startswith("network/")])),
    Case("generator: no asset", FILE, "does not exist|no asset|asset", tensors(lambda t: [t.pop(k) for k in [*t] if k.startswith("asset/")])),
    Case("generator: an asset outside", FILE, "outside", tensors(lambda t: t.update({"asset/../evil.ply": t["asset/files/ball.ply"]}))),
    Case("generator: a mesh outside", FILE, "outside", tensors(len, lambda r: r["source"].update(mesh="../../etc/passwd"))),
    Case("generator: steps of minus one", FILE, "step", tensors(len, lambda r: r.update(step=-1))),
    Case("generator: a step in words", FILE, "step", tensors(len, lambda r: r.update(step="many"))),
    Case("generator: 10^9 steps of noise", FILE, "model.steps", tensors(len, lambda r: r["experiment"]["model"].update(steps=10**9))),
    Case("generator: a schedule beyond noise", FILE, "beta", tensors(len, lambda r: r["experiment"]["model"].update(beta_end=2.0))),
    Case("generator: another codec", FILE, "differs|scaling|codec", tensors(len, lambda r: r["codec"].update(latents=5))),
    Case("generator: no source", FILE, "cannot be used", tensors(len, lambda r: r.pop("source"))),
    # weights
    Case("weights: missing", WEIGHTS, "holds no FL-VAE weights"),
    Case("weights: a text", WEIGHTS, "holds no FL-VAE weights", put("w.safetensors", "weights")),
    Case("weights: a generator", WEIGHTS.replace("w.safe", "g.safe"), "holds no FL-VAE weights"),
    Case("weights: 100,000 layers", WEIGHTS, "depth is 100000", weights(lambda r: r.update(depth=100_000))),
    Case("weights: an unknown field", WEIGHTS, "holds no FL-VAE weights", weights(lambda r: r.update(code="x"))),
    Case("weights: of NaN", WEIGHTS, "not finite", weights(len, lambda t: t.update({k: np.full_like(v, np.nan) for k, v in [*t.items()][:1]}))),
    Case("weights: of another size", WEIGHTS, "differs", weights(lambda r: r.update(width=8))),
    # folders of images
    Case("images: no folder", IMAGES, "holds no images"),
    Case("images: a file", IMAGES, "holds no images", put("pictures", "x")),
    Case("images: texts alone", IMAGES, "holds no images", put("pictures/a.txt", "x")),
    Case("images: PostScript", IMAGES, "no known kind", put("pictures/a.png", PS)),
    Case("images: cut off", IMAGES, "broken", put("pictures/a.png", png(64, 64)[:2000])),
    Case("images: 20,000 × 20,000", IMAGES, "pixels", put("pictures/a.png", png_bomb(20000, 20000))),
    Case("images: a folder called a.png", IMAGES, "a.png", lambda folder: (folder / "pictures" / "a.png").mkdir(parents=True)),
    Case("images: a pipe", IMAGES, "a.png", lambda folder: ((folder / "pictures").mkdir(), os.mkfifo(folder / "pictures" / "a.png"))),
    Case("images: a link to a device", IMAGES, "a.png", lambda folder: ((folder / "pictures").mkdir(), (folder / "pictures" / "a.png").symlink_to("/dev/zero"))),
    # other meshes
    Case("mesh: missing", f"{FILE} --mesh b.obj", "does not exist"),
    Case("mesh: empty", f"{FILE} --mesh b.stl", "is empty", put("b.stl", b"")),
    Case("mesh: no faces", f"{FILE} --mesh b.obj", "no triangles", put("b.obj", "v 0 0 0\n")),
    Case("mesh: STL of 4e9 triangles", f"{FILE} --mesh b.stl", "4,294,967,295 triangles do not fit", put("b.stl", bytes(80) + b"\xff\xff\xff\xff" + bytes(50))),
    Case("mesh: OFF of words", f"{FILE} --mesh b.off", "b.off", put("b.off", "OFF\none two three\n")),
    Case("mesh: NaN", f"{FILE} --mesh b.obj", "not finite", put("b.obj", "v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")),
    # options
    Case("count 0", f"{FILE} --count 0", "--count is 0; give at least 1"),
    Case("seed -1", f"{FILE} --seed -1", "seed is -1"),
    Case("texture size 0", f"{FILE} --texture-size 0", "texture"),
    Case("texture size 10^9", f"{FILE} --texture-size 1000000000", "texture"),
    Case("scale 0", f"{FILE} --scale 0", "scale"),
    Case("scale NaN", f"{FILE} --scale nan", "scale"),
    Case("scale 1e9", f"{FILE} --scale 1e9", "scale"),
    Case("strength 2", f"{FILE} --strength 2", "strength"),
    Case("invention NaN", f"{FILE} --invention nan", "invention"),
    Case("coherence -1", "sample ball.ply --instant --coherence -1 --out new", "coherence"),
    Case("instant: 3 vertices", "sample ball.ply --instant --vertices 3 --out new", "vertices"),
    Case("a file as --out", f"{FILE.replace('new', 'a.obj')}", "is a file"),
    Case("labels: 9 colours", "labels a.obj --colors 9", "colors is 9"),
    Case("labels: over a file that is there", "labels a.obj --out a.png", "is there already"),
    Case("evaluate: no samples", "evaluate a.obj", "--samples"),
    Case("evaluate: two of one name", "evaluate a.obj --samples ball.ply x/ball.ply", "same name"),
    Case("reconstruct: 3 vertices", "reconstruct ball.ply --vertices 3 --out new", "vertices"),
    # what painting starts from
    Case("paint: start is missing", "paint a.obj --no-browser --start m.png", "does not exist"),
    Case("paint: start is a text", "paint a.obj --no-browser --start m.png", "no known kind", put("m.png", "x")),
    Case("paint: start is a photograph", "paint a.obj --no-browser --start m.png", "labels m.png", put("m.png", png(64, 64))),
    Case("paint: a mask of another size", "paint a.obj --keep --no-browser --start m.png", "5 × 5", put("m.png", picture(5, 5))),
    Case("paint: strokes are a list", "paint a.obj --direction --no-browser --start s.json", "no strokes", put("s.json", "[]")),
    Case("paint: two things at once", "paint a.obj --keep --direction --no-browser", "at once"),
    Case("paint: over a file that is there", "paint a.obj --no-browser --out a.png", "is there already"),
    Case("paint: no coordinates", "paint ball.ply --no-browser", "no texture coordinates"),
]  # fmt: skip


def drawing(labels: object, numbers: object) -> bytes:
    return json.dumps({"labels": labels, "numbers": numbers}).encode()


def packed(numbers: bytes) -> str:
    return base64.b64encode(zlib.compress(numbers, 9)).decode()


TWO = [{"name": "rest", "color": "#808080"}, {"name": "spot", "color": "#ff0000"}]
REQUESTS = [
    Request("save: nothing", b"", "no JSON object"),
    Request("save: 60,000 brackets", b"[" * 60_000, "no JSON object"),
    Request("save: an integer of 10,000 digits", b'{"labels":' + b"9" * 10_000 + b"}", "no JSON object"),
    Request("save: UTF-16", '{"labels": 1}'.encode("utf-16")[1:], "no JSON object"),
    Request("save: labels in words", drawing("all", ""), "not a list of 2 to 32"),
    Request("save: 33 labels", drawing(TWO * 17, ""), "not a list of 2 to 32"),
    Request("save: a label is a number", drawing([*TWO, 3], ""), "label 2 has no name"),
    Request("save: a name of 61 letters", drawing([*TWO, {"name": "x" * 61, "color": "#00ff00"}], ""), "label 2 has no name"),
    Request("save: a name that is turned", drawing([*TWO, {"name": "\u202egnp", "color": "#00ff00"}], ""), "label 2 has no name"),
    Request("save: a colour with a script", drawing([*TWO, {"name": "x", "color": "#fff;url(x)"}], ""), "no colour"),
    Request("save: no texels", drawing(TWO, None), "base64"),
    Request("save: too few texels", drawing(TWO, packed(bytes(15))), "not 16 bytes"),
    Request("save: deflated zeros of 40 MB", drawing(TWO, packed(bytes(40 << 20))), "not 16 bytes"),
    Request("save: cut off in the middle", drawing(TWO, packed(bytes(16))[:-8]), "base64|not 16 bytes"),
    Request("save: label 255", drawing(TWO, packed(b"\xff" * 16)), "label 255"),
    Request("save: a mask of three", drawing([], packed(b"\x02" * 16)), "label 2", "keep"),
    Request("save: strokes of NaN", b'{"strokes": [{"points": [[NaN, 0, 0], [0, 0, 0]]}]}', "three finite", "direction"),
    Request("save: strokes far away", b'{"strokes": [{"points": [[9, 9, 9], [9, 9, 8]]}]}', "away from the surface", "direction"),
    Request("save: 20,000 points", json.dumps({"strokes": [{"points": [[0, 0, 0]] * 20_000}]}).encode(), "20,000 points", "direction"),
    Request("save: an unknown field", b'{"strokes": [{"points": [[0, 0, 0], [1, 0, 0]], "run": "x"}]}', "unknown field", "direction"),
    Request("fill: texel -1", b'{"texel": -1, "tolerance": 0.1}', "none of the atlas", answer="similar"),
    Request("fill: a texel that is true", b'{"texel": 1e99, "tolerance": 0.1}', "none of the atlas", answer="similar"),
    Request("fill: tolerance NaN", b'{"texel": 5, "tolerance": NaN}', "tolerance", answer="similar"),
    Request("request: another origin", b"{}", "only the page itself", headers=(("Origin", "https://evil.example"),)),
    Request("request: another host", b"{}", "alone", headers=(("Host", "evil.example"),)),
    Request("request: more bytes than it may", b"{}", "more than", headers=(("Content-Length", str(1 << 40)),)),
    Request("request: a length in words", b"{}", "how long", headers=(("Content-Length", "-1"),)),
    Request("request: nothing of that name", b"{}", "nothing here", answer="../../etc/passwd"),
]  # fmt: skip


# ------------------------------------------------------------------------------------------------- runner


def untrained(folder: Path, labelled: bool = False) -> Generator:
    """A generator of the coloured ball whose network is constant: nothing is compiled to make it."""
    (folder / "ball.ply").write_bytes(colored_sphere())
    asset, codec, tables = read_asset(folder / "ball.ply"), load_codec(), mesh_tables(icosphere(2))
    model = FLDM(channels=4, embedding=8, precision="float32", steps=20)
    model = complete(model, codec.config, 162, 3 * labelled)
    experiment = FLDMExperiment("run", Surface("ball.ply", vertices=162, copies=1), model=model)
    shapes = parameter_shapes(model, tables)
    params = jax.tree.map(lambda leaf: np.full(leaf.shape, 0.01, leaf.dtype), shapes)
    files, labels, place = {"files/ball.ply": colored_sphere()}, None, None
    if labelled:
        files[place := "labels/zones.ply"] = labelled_sphere()
        palette = np.array([(0, 0, 0), (0, 0, 200), (200, 0, 0)], np.uint8)
        labels = Labels(palette, (np.arange(162) % 3).astype(np.int32))
    scaling = Scaling(np.zeros(8, np.complex64), np.full(8, 1 + 1j, np.complex64))
    source = Source("files/ball.ply", None, asset.digest, files, place)
    home = Home(icosphere(2), tables)
    return learnt_generator(experiment, params, scaling, codec, home, source, 7, labels)


def good_folder(folder: Path) -> None:
    """What the commands find before a stranger comes."""
    obj()(folder)
    save_generator(folder / "g.safetensors", made := untrained(folder))
    save_generator(folder / "labelled.safetensors", untrained(folder, labelled=True))
    run = open_run(folder, made.experiment, "0" * 64)
    shutil.copy(folder / "g.safetensors", run.generator)


def measured(work: Callable[[], tuple[int, list[str]]], folder: Path) -> Outcome:
    before = {path.relative_to(folder) for path in folder.rglob("*")}
    forget_peak()
    start = time.process_time()
    signal.alarm(30)
    try:
        status, lines = work()
    except BaseException as uncaught:
        status, lines = -1, [f"{type(uncaught).__name__}: {uncaught}"[:300]]
    signal.alarm(0)
    seconds = time.process_time() - start
    peak = peak_megabytes()
    left = {path.relative_to(folder) for path in folder.rglob("*")} - before
    ours = (".lock", ".trainer")  # of the run
    return Outcome(status, lines, seconds, peak, sorted(map(str, left - {Path("run", n) for n in ours})))


def run_case(case: Case, good: Path, folder: Path) -> Outcome:
    shutil.copytree(good, folder, symlinks=True)
    case.make(folder)
    os.chdir(folder)

    def work() -> tuple[int, list[str]]:
        said, told = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(told):
            status = main(case.words.split())
        return status, told.getvalue().splitlines()

    outcome = measured(work, folder)
    os.chdir(good)
    shutil.rmtree(folder)
    return outcome


def run_request(request: Request, good: Path, folder: Path) -> Outcome:
    folder.mkdir()
    asset = read_asset(good / "a.obj")
    if request.mode == "direction":
        painter = StrokePainter(asset, folder / "x.json")
    else:
        painter = TexelPainter(asset, folder / "x.png", request.mode, (4, 4))  # pyright: ignore
    with serving(painter.answers(), painter.most) as server:

        def work() -> tuple[int, list[str]]:
            link = http.client.HTTPConnection(server.host, timeout=10)
            headers = {"Origin": f"http://{server.host}", **dict(request.headers)}
            link.request("POST", f"/{server.secret}/{request.answer}", request.body, headers)
            answer = link.getresponse()
            return answer.status, answer.read().decode().splitlines()

        outcome = measured(work, folder)
    shutil.rmtree(folder)
    return outcome


def _too_long(*_: object) -> None:
    raise TimeoutError("30 seconds")


def traced_once() -> None:
    """What parameters a network has takes seconds to find out, and hangs on its configuration alone."""
    shapes, traced = {}, parameter_shapes

    def remembered(model: FLDM, tables: Any) -> Any:
        key = model, len(tables.fine.masses)
        return shapes[key] if key in shapes else shapes.setdefault(key, traced(model, tables))

    flx.pipeline.generator.parameter_shapes = remembered


def table() -> dict[str, Outcome]:
    resource.setrlimit(resource.RLIMIT_AS, (64 << 30, 64 << 30))
    signal.signal(signal.SIGALRM, _too_long)
    os.environ["FLX_CACHE"] = ""
    traced_once()
    here = Path.cwd()
    with TemporaryDirectory() as name:
        good = Path(name).resolve() / "good"
        good.mkdir()
        good_folder(good)
        rows = {case.name: run_case(case, good, good.parent / "spoilt") for case in CASES}
        rows |= {r.name: run_request(r, good, good.parent / "spoilt") for r in REQUESTS}
        os.chdir(here)
    return rows


if __name__ == "__main__":
    rows = table()
    if "--json" in sys.argv:
        print(json.dumps({name: row._asdict() for name, row in rows.items()}))
    else:
        print("| case | answered | CPU s | MB |\n|---|---|---|---|")
        for name, row in rows.items():
            print(
                f"| {name} | {row.status}: {' / '.join(row.lines)[:300]} | {row.seconds:.2f} | {row.megabytes:.0f} |"
            )
        total, worst = sum(row.seconds for row in rows.values()), max(row.seconds for row in rows.values())
        most = max(row.megabytes for row in rows.values())
        print(f"\n{len(rows)} cases, {total:.0f} CPU s, the longest {worst:.2f} s, at most {most:.0f} MB")
