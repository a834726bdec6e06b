# ruff: noqa: E501  (the table of cases: one line each)
"""Wrong arguments of public functions, and what is said of each; python tests/reports/door.py prints it.

Run by itself: in the tests jaxtyping would refuse many of them, which is not there for users.
"""

import json
import sys
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

import flx
from flx.assets.asset import Painting, own_painting
from flx.geometry.tables import mesh_tables
from flx.types import RingSamples, Triangulation

V = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
F = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
WHITE, UVS, IMAGE = np.ones((4, 3)), V[:, :2], np.zeros((8, 8, 3), np.uint8)
SOUP = Triangulation(V[F].reshape(-1, 3), np.arange(12).reshape(4, 3))
A = flx.from_arrays(V, F, colors=WHITE)
OWN = own_painting(A)


class Call(NamedTuple):
    name: str
    call: Callable[[Any], Any]  # of what is made once: see `Things`
    match: str  # what its line says


class Things:
    """What takes a second to make, made at its first use, and a folder to write to."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.codec = flx.load_codec()
        self.copy = flx.triangulate(A, 100)
        self.codes = np.zeros((100, 8), np.complex64)


def spoilt(array: np.ndarray, value: float) -> np.ndarray:
    """The array with this value in row 1."""
    array = np.array(array, float)
    array[1, 0] = value
    return array


def fan(count: int) -> Triangulation:
    """A vertex with so many neighbours."""
    angles = 2 * np.pi * np.arange(count) / count
    rim = np.stack([np.cos(angles), np.sin(angles), 0 * angles], 1)
    n = np.arange(count)
    return Triangulation(np.vstack([[[0, 0, 0.2]], rim]), np.stack([0 * n, 1 + n, 1 + (n + 1) % count], 1))


def arrays(name: str, match: str, /, **changed: Any) -> Call:
    return Call(
        f"from_arrays: {name}",
        lambda _: flx.from_arrays(**{"vertices": V, "faces": F, "colors": WHITE, **changed}),
        match,
    )


def imaged(name: str, match: str, /, **changed: Any) -> Call:
    return Call(
        f"from_arrays: {name}",
        lambda _: flx.from_arrays(**{"vertices": V, "faces": F, "uvs": UVS, "image": IMAGE, **changed}),
        match,
    )


def tables(name: str, match: str, vertices: Any, faces: Any, **options: Any) -> Call:
    return Call(
        f"mesh_tables: {name}", lambda _: mesh_tables(Triangulation(vertices, faces), **options), match
    )


def copy(name: str, match: str, **options: Any) -> Call:
    return Call(
        f"triangulate: {name}", lambda _: flx.triangulate(**{"asset": A, "vertices": 100, **options}), match
    )


def setting(name: str, match: str, make: Callable[[], Any]) -> Call:
    return Call(f"setting: {name}", lambda _: make(), match)


def painted(name: str, match: str, **changed: Any) -> Call:
    return Call(
        f"paint: {name}",
        lambda t: flx.paint(**{"asset": A, "copy": t.copy, "codec": t.codec, "latents": t.codes, **changed}),
        match,
    )


ODD: tuple[tuple[str, Any], ...] = (
    ("None", None),
    ("a number", 3),
    ("a list", [1, 2]),
    ("an array", np.zeros(3)),
)

CALLS = [
    # from_arrays
    *(arrays(f"a vertex of {x}", r"vertices\[1\] is .*finite", vertices=spoilt(V, x)) for x in (np.nan, np.inf, -np.inf, 1e300)),
    arrays("an index too large", r"faces\[3\] is \[1, 2, 9\], but there are 4", faces=[*F[:3].tolist(), [1, 2, 9]]),
    arrays("an index of -1", r"faces\[0\] is \[-1", faces=F - 1),
    arrays("half an index", r"faces\[0\] is .*indices", faces=F + 0.5),
    arrays("an index of NaN", r"faces\[0\] is .*indices", faces=F * np.nan),
    arrays("an index of infinity", r"faces\[0\] is .*indices", faces=[[0, 1, np.inf]]),
    arrays("an index of 30 digits", "faces", faces=[[0, 1, 10**30]]),
    arrays("an index as text", "faces is not an array of numbers", faces=[["0", "1", "2"]]),
    arrays("faces of truth values", "faces is not an array of numbers .*bool", faces=F.astype(bool)),
    arrays("quads", r"faces has shape \[2, 4\]", faces=np.zeros((2, 4), int)),
    arrays("one flat list of faces", r"faces has shape \[3\]", faces=[0, 1, 2]),
    arrays("faces in rows of 3 and 2", "faces is not an array", faces=[[0, 1, 2], [0, 1]]),
    arrays("no faces", "at least one triangle", faces=[]),
    arrays("all corners the same", "corner twice", faces=[[0, 0, 0]]),
    arrays("positions in the plane", r"vertices has shape \[4, 2\]", vertices=UVS),
    arrays("vertices of complex numbers", "vertices is not an array of numbers .*complex", vertices=V.astype(complex)),
    arrays("vertices of None", "vertices is not an array of numbers .*object", vertices=np.full((4, 3), None)),
    arrays("vertices of text", "vertices is not an array of numbers", vertices=[["a", "b", "c"]] * 4),
    arrays("vertices of dates", "vertices is not an array of numbers", vertices=np.zeros((4, 3), "datetime64[s]")),
    arrays("rows of 3 and 1", "vertices is not an array of numbers .*different lengths", vertices=[[0, 0, 0], [1]]),
    arrays("no vertices", "vertices has shape", vertices=[]),
    arrays("all in one place", "corner twice", vertices=np.zeros((4, 3))),
    *(arrays(f"vertices are {what}", "vertices (has shape|is not an array)", vertices=value) for what, value in ODD),
    *(arrays(f"faces are {what}", "faces (has shape|is not an array)", faces=value) for what, value in ODD),
    *(arrays(f"colors are {what}", "(colors has shape|colors is not an array|give an image)", colors=value) for what, value in ODD),
    *(arrays(f"colours of {kind.__name__} up to 200", "colors has the value 200", colors=(WHITE * 200).astype(kind)) for kind in (np.float64, np.float32, np.int64, np.uint16)),
    arrays("colours of -0.1", "colors has the value -0.1", colors=WHITE * -0.1),
    arrays("a colour of NaN", "colors has the value nan", colors=spoilt(WHITE, np.nan)),
    arrays("colours of complex numbers", "colors is not an array of numbers", colors=WHITE.astype(complex)),
    arrays("colours of text", "colors is not an array of numbers", colors=np.full((4, 3), "red")),
    arrays("colours of None", "colors is not an array of numbers", colors=np.full((4, 3), None)),
    arrays("three colours for four vertices", r"colors has shape \[3, 3\]", colors=WHITE[:3]),
    arrays("grey colours", r"colors has shape \[4, 1\]", colors=WHITE[:, :1]),
    arrays("a name of 3", "name is 3", name=3),
    arrays("uvs without an image", "image together with uvs", uvs=UVS),
    imaged("a file's name for an image", "image is not an array of numbers", image="bowl.png"),
    imaged("a grey image", r"image has shape \[8, 8\]", image=IMAGE[..., 0]),
    imaged("an image of 5 channels", r"image has shape", image=np.zeros((8, 8, 5))),
    imaged("an image of no pixels", "at least one pixel", image=np.zeros((0, 8, 3))),
    imaged("an image of NaN", "image has the value nan", image=IMAGE * np.nan),
    imaged("an image of 16 bits", "image has the value 60000", image=np.full((8, 8, 3), 60000, np.uint16)),
    imaged("an image without uvs", "image together with uvs", uvs=None),
    imaged("uvs of NaN", r"uvs\[1\] is", uvs=spoilt(UVS, np.nan)),
    imaged("uvs of 1e9", "covers its textures", uvs=UVS * 1e9),
    imaged("uvs of text", "uvs is not an array", uvs="uv"),
    imaged("uvs in rows of 1 and 2", "uvs is not an array", uvs=[[0], [1, 2]]),
    imaged("uvs of three numbers", r"uvs has shape \[4, 3\]", uvs=V),
    imaged("uvs of corners of other faces", r"uvs has shape \[2, 3, 2\]", uvs=np.zeros((2, 3, 2))),
    # a triangulation of one's own
    *(tables(f"a vertex of {x}", r"vertices\[1\] is .*finite", spoilt(V, x), F) for x in (np.nan, np.inf)),
    tables("an index too large", r"faces\[0\] is \[3, 5, 4\], but there are 4 vertices", V, F + 3),
    tables("an index of -1", r"faces\[0\] is \[-1, 1, 0\]", V, F - 1),
    tables("lists", "vertices is a list; .*NumPy", V.tolist(), F.tolist()),
    tables("a list of faces", "faces is a list; .*NumPy", V, F.tolist()),
    tables("faces of floats", "faces are float64.*indices of vertices", V, F.astype(float)),
    tables("faces of truth values", "faces are bool", V, F.astype(bool)),
    tables("vertices of whole numbers", "vertices are int64.*real numbers", V.astype(int), F),
    tables("vertices of complex numbers", "vertices are complex128", V.astype(complex), F),
    tables("positions in the plane", r"vertices are float64, \[4, 2\]", UVS, F),
    tables("quads", r"faces are int64, \[1, 4\]", V, np.array([[0, 1, 2, 3]])),
    tables("no faces", "no faces; give", V, F[:0]),
    tables("a corner twice", r"faces\[4\] is \[0, 0, 1\]: a corner twice", V, np.vstack([F, [[0, 0, 1]]])),
    tables("no area", "no face has an area", np.zeros((4, 3)), F),
    tables("soup that was not welded", "no two share a vertex; weld them", *SOUP),
    tables("three faces at an edge", "edge 0 → 1 has two faces on one side; make", np.vstack([V, [[9, 9, 9]]]), np.vstack([F, [[0, 1, 4]]])),
    tables("a face turned over", "two faces on one side; make", V, np.vstack([F[:3], F[3:, ::-1]])),
    tables("two fans at a vertex", "vertex 0 joins several fans", np.vstack([V, -V[1:]]), np.array([[0, 2, 1], [0, 5, 4]])),
    tables("64 neighbours", "vertex 0 has 64 neighbours .*raise slots", *fan(64)),
    *(tables(f"{n} neighbours for 16 slots", f"vertex 0 has {n} neighbours", *fan(n)) for n in (16, 17, 40)),
    tables("slots of text", "slots is 'many'; give a whole number", V, F, slots="many"),
    tables("slots of 2", "slots is 2; give at least 4", V, F, slots=2),
    tables("a seed of -1", "seed is -1; give at least 0", V, F, seed=-1),
    tables("no coarse vertices", "coarse_count is 0", V, F, coarse_count=0),
    tables("too many coarse vertices", "coarse_count is 5", V, F, coarse_count=5),
    *(Call(f"mesh_tables: of {what}", lambda _, value=value: mesh_tables(value), "triangulation is .*; give a Triangulation") for what, value in (*ODD, ("a tuple", (V, F)), ("an Asset", A))),
    # triangulate
    *(copy(f"of {what}", "asset is .*; give an Asset", asset=value) for what, value in (*ODD, ("a path", "bowl.glb"), ("its mesh", A.mesh))),
    *(copy(f"{n} vertices", f"vertices is {n}; give at least 4", vertices=n) for n in (-5, 0, 3)),
    *(copy(f"{n!r} vertices", "vertices is .*; give a whole number", vertices=n) for n in (100.5, 100.0, float("nan"), "100", None, True)),
    copy("10¹² vertices", "GB of memory", vertices=10**12),
    *(copy(f"{n!r} samples", "samples is .*; give", samples=n) for n in (0, -1, 2.5, None)),
    *(copy(f"{n!r} slots", "slots is .*; give", slots=n) for n in (0, 2, 16.0, "16")),
    *(copy(f"a seed of {n!r}", "seed is .*; give", seed=n) for n in (-1, 1.5, None, "0")),
    # files
    *(Call(f"load: {what}", lambda _, value=value: flx.load(value), "path is .*; give a mesh file") for what, value in (*ODD, ("nothing", ""))),
    *(Call(f"load_shape: {what}", lambda _, value=value: flx.load_shape(value), "path is .*; give a mesh file") for what, value in ODD),
    Call("load: a texture of 3", lambda t: flx.load(t.folder / "a.ply", 3), "texture is 3; give an image file"),
    Call("load: slots of one word", lambda t: flx.load(t.folder / "a.ply", slots="normal"), r"slots is 'normal'; give a list, \['normal'\]"),
    Call("load: a slot that is none", lambda t: flx.load(t.folder / "a.ply", slots=["bump"]), "slots is 'bump'; choose one of base_color"),
    Call("load_shape: a format that is none", lambda t: flx.load_shape(t.folder / "a.ply", "usd"), "format is 'usd'; choose one of glb"),
    Call("load_codec: a number", lambda _: flx.load_codec(3), "path is 3; give an FL-VAE file"),
    Call("load_codec: nothing", lambda _: flx.load_codec(""), "path is ''; give an FL-VAE file"),
    Call("load_codec: another file", lambda _: flx.load_codec(__file__), "holds no FL-VAE weights"),
    *(Call(f"load_generator: {what}", lambda _, value=value: flx.load_generator(value), "path is .*; give a run folder") for what, value in ODD),
    Call("load_generator: no such run", lambda t: flx.load_generator(t.folder / "none"), "does not exist; give a run"),
    Call("load_generator: another file", lambda _: flx.load_generator(__file__), "cannot be used as a generator"),
    Call("save: no painting", lambda t: flx.save(A, None, t.folder / "x.ply"), "painting is None; give a Painting"),
    Call("save: painting and asset exchanged", lambda t: flx.save(OWN, A, t.folder / "x.ply"), "asset is a Painting; give an Asset"),
    Call("save: an image as a painting", lambda t: flx.save(A, IMAGE, t.folder / "x.ply"), "painting is a ndarray; give"),
    Call("save: no path", lambda _: flx.save(A, OWN, None), "path is None; give a file"),
    *(Call(f"save: suffix {s!r}", lambda t, s=s: flx.save(A, OWN, t.folder / f"x{s}"), "no suffix of .glb") for s in (".stl", ".usd", "", ".png")),
    Call("save: a folder", lambda t: flx.save(A, OWN, (t.folder / "f.ply").mkdir() or t.folder / "f.ply"), "is a folder"),
    Call("save: three colours for four", lambda t: flx.save(A, Painting({}, np.zeros((3, 3), np.float32)), t.folder / "x.ply"), "3 colours for the 4"),
    Call("save: a colour of NaN", lambda t: flx.save(A, Painting({}, np.full((4, 3), np.nan, np.float32)), t.folder / "x.ply"), r"painting.colors\[0\] is"),
    *(Call(f"fidelity: a painting that is {what}", lambda _, value=value: flx.fidelity(A, value), "painting is .*; give a Painting") for what, value in ODD),
    Call("fidelity: of a path", lambda _: flx.fidelity("a.glb", OWN), "asset is 'a.glb'; give an Asset"),
    Call("to_trimesh: of a path", lambda _: flx.to_trimesh("a.glb"), "asset is 'a.glb'; give an Asset"),
    Call("to_trimesh: a painting of 3", lambda _: flx.to_trimesh(A, 3), "painting is 3; give a Painting"),
    *(Call(f"from_trimesh: {what}", lambda _, value=value: flx.from_trimesh(value), "mesh is .*; give a Trimesh") for what, value in (*ODD, ("a path", "a.stl"))),
    Call("picture: a path", lambda _: flx.picture("a.glb"), "asset is 'a.glb'; give an Asset"),
    Call("picture: an asset as a painting", lambda _: flx.picture(A, A), "painting 0 is an Asset; give a Painting"),
    Call("picture: up is x", lambda _: flx.picture(A, OWN, up="x"), "up is 'x'; choose one of y, z"),
    *(Call(f"picture: {n!r} pixels", lambda _, n=n: flx.picture(A, OWN, size=n), "size is .*; give") for n in (0, -1, 100.5, "big")),
    *(Call(f"show: {what}", lambda _, value=value: flx.show(value), "what is .*; give an Asset") for what, value in ODD),
    Call("show: a path to nothing", lambda _: flx.show("a.glb"), "a.glb is not there; flx sample and"),
    Call("show: no path", lambda _: flx.show(""), "what is ''; give a folder"),
    Call("show: another file", lambda _: flx.show(__file__), "is no page of flx; give"),
    Call("show: an asset as a painting", lambda _: flx.show(A, A), "painting 0 is an Asset; give a Painting"),
    Call("show: up is x", lambda _: flx.show(A, OWN, up="x"), "up is 'x'; choose one of y, z"),
    *(Call(f"show: {n!r} pixels", lambda _, n=n: flx.show(A, OWN, height=n), "height is .*; give") for n in (0, -1, 100.5, "big")),
    # codes
    painted("of a path", "asset is 'a.glb'; give an Asset", asset="a.glb"),
    painted("no copy", "copy is None; give what flx.triangulate", copy=None),
    painted("no codec", "codec is None; give what flx.load_codec", codec=None),
    *(painted(f"codes that are {what}", r"give \[100, 8\]", latents=value) for what, value in ODD),
    painted("codes of NaN", "not all finite numbers", latents=np.full((100, 8), np.nan, complex)),
    painted("codes of None", "not all finite numbers", latents=np.full((100, 8), None)),
    painted("codes of text", r"not all finite numbers", latents=np.full((100, 8), "z")),
    painted("99 codes", r"latents have shape \[99, 8\]", latents=np.zeros((99, 8))),
    *(painted(f"{n!r} pixels", "texture_size is .*; give", texture_size=n) for n in (0, 4, 10**6, 100.5, "big")),
    *(Call(f"encode: {what}", lambda t, value=value: t.codec.encode(value), "rings is .*; give the rings") for what, value in ODD),
    Call("encode: 10 samples", lambda t: t.codec.encode(flx.triangulate(A, 100, samples=10).rings), "10.*; give 64 samples"),
    Call("encode: no samples", lambda t: t.codec.encode(RingSamples(np.zeros((5, 0)), np.zeros((5, 0, 3)))), "give 64 samples"),
    *(Call(f"generate: {what}", lambda _, value=value: next(flx.generate(value)), "generator is .*; give what flx.load_generator") for what, value in (*ODD, ("a run's name", "runs/bowl"))),
    # train
    *(Call(f"train: {what}", lambda t, value=value: flx.train(value, t.folder), "experiment is .*; give an FLDMExperiment") for what, value in (*ODD, ("a path", "bowl.glb"), ("a Surface", flx.Surface()))),
    *(Call(f"train: {n!r} workers", lambda t, n=n: flx.train(flx.quick(), t.folder, n), "workers is .*; give") for n in (0, -1, 1.5, "2")),
    Call("quick: an asset", lambda _: flx.quick(flx.vase()), "path is an Asset; give .*export"),
    Call("train: no root", lambda _: flx.train(flx.quick(), None), "root is None; give the folder"),
    Call("train: a name with a slash", lambda t: flx.train(flx.quick(name="a/b"), t.folder), "not a folder name"),
    # settings
    *(setting(f"vertices={v!r}", "surface.vertices is .*; give", lambda v=v: flx.Surface(vertices=v)) for v in (3, -1, 100.5, float("nan"), "many", None, True)),
    *(setting(f"copies={v!r}", "surface.copies is .*; give", lambda v=v: flx.Surface(copies=v)) for v in (0, 1.5, None)),
    *(setting(f"path={v!r}", "surface.path is .*; give text", lambda v=v: flx.Surface(path=v)) for v in (None, 3, Path("a.glb"))),
    *(setting(f"steps={v!r}", "train.steps is .*; give", lambda v=v: flx.Train(steps=v)) for v in (0, None, "all", 1.5)),
    *(setting(f"learning_rate={v!r}", "train.learning_rate is .*; give", lambda v=v: flx.Train(learning_rate=v)) for v in (-1, float("nan"), float("inf"), "fast", None)),
    *(setting(f"ema={v!r}", "train.ema is .*; give", lambda v=v: flx.Train(ema=v)) for v in (1, 2.0, -0.1, None)),
    *(setting(f"blocks={v!r}", "model.blocks is .*; give three", lambda v=v: flx.FLDM(blocks=v)) for v in ((1, 2), (), "123", (1, 2, -1), (1, 2, 1.5), (1, 1, 10**6), [1, 1, 1], 3)),
    *(setting(f"embedding={v!r}", "model.embedding is", lambda v=v: flx.FLDM(embedding=v)) for v in (2, 5, None)),
    *(setting(f"network={v!r}", "model.network is|model.predicts", lambda v=v: flx.FLDM(predicts=v)) for v in ("noises", None, 3)),
    *(setting(f"strength={v!r}", "strength is .*; give", lambda v=v: flx.Controls(strength=v)) for v in (0, 2, -1, float("nan"), "much", None)),
    *(setting(f"labels={v!r}", "labels is .*; give the name of a file", lambda v=v: flx.Controls(labels=v)) for v in (3, "")),
    *(setting(f"direction={v!r}", "direction is .*; give x, y, z, curvature, or a JSON", lambda v=v: flx.Controls(direction=v)) for v in (3, "")),
    *(setting(f"height={v!r}", "height is .*; give the axis", lambda v=v: flx.Controls(height=v)) for v in ("up", "", 2, "Z")),
    *(setting(f"rotate={v!r}", "rotate is .*; give a number", lambda v=v: flx.Controls(rotate=v)) for v in (float("nan"), float("inf"), "left", None)),
    *(setting(f"surface.direction={v!r}", "surface.direction is .*; give text", lambda v=v: flx.Surface(direction=v)) for v in (3, None, Path("a.json"))),
    *(setting(f"scale={v!r}", "scale is .*; give", lambda v=v: flx.Controls(scale=v)) for v in (0, -1, float("inf"), "big", None)),
    setting("heads that do not divide", "model.heads is 7", lambda: flx.FLVAE(heads=7)),
    setting("invariants of the transformer", "model.invariants is 2", lambda: flx.FLVAE(invariants=2)),
]  # fmt: skip

GOOD: dict[str, Callable[[Any], Any]] = {
    "lists": lambda _: flx.from_arrays(V.tolist(), F.tolist(), colors=WHITE.tolist()),
    "float32 and int32": lambda _: mesh_tables(Triangulation(V.astype(np.float32), F.astype(np.int32))),
    "soup, welded": lambda _: flx.from_arrays(*SOUP, colors=np.ones((12, 3))),
    "a PIL image": lambda _: flx.from_arrays(V, F, UVS, image=Image.fromarray(IMAGE)),
    "a number of NumPy": lambda _: flx.triangulate(A, np.int64(100)),
    "15 neighbours": lambda _: mesh_tables(fan(15)),
    "64 neighbours in 65 slots": lambda _: mesh_tables(fan(64), slots=65),
    "a vertex without faces": lambda _: mesh_tables(Triangulation(np.vstack([V, [[9, 9, 9]]]), F)),
    "real codes": lambda t: flx.paint(A, t.copy, t.codec, t.codes.real),
    "codes in lists": lambda t: flx.paint(A, t.copy, t.codec, t.codes.tolist()),
    "a path of pathlib": lambda _: flx.quick(Path("bowl.glb")),
}


class Answer(NamedTuple):
    kind: str  # of the exception, "" for none
    said: str
    warned: list[str]


def answer(call: Callable[[Any], Any], things: Things) -> Answer:
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        try:
            call(things)
            kind, said = "", ""
        except Exception as error:
            kind, said = type(error).__name__, str(error)
            if "--verbose" in sys.argv and kind != "ValueError":
                traceback.print_exc()
    return Answer(kind, said, [str(warning.message) for warning in warned])


def table() -> dict[str, Answer]:
    with TemporaryDirectory() as folder:
        things = Things(Path(folder))
        flx.save(A, OWN, Path(folder, "a.ply"))
        calls = GOOD | {call.name: call.call for call in CALLS}
        rows = {name: answer(call, things) for name, call in calls.items()}
        left = sorted(path.name for path in Path(folder).iterdir())
        return rows | {"left in the folder": Answer("", ", ".join(left), [])}


if __name__ == "__main__":
    assert len({call.name for call in CALLS}) == len(CALLS), "two calls of one name"
    rows = table()
    if "--json" in sys.argv:
        print(json.dumps(rows))
    else:
        print("| call | said |\n|---|---|")
        for name, row in rows.items():
            print(f"| {name} | {row.kind} {row.said or '(taken)'} {row.warned or ''} |")
