"""`flx evaluate --reconstruction`: one table of how well each method keeps the textures of some meshes.

A row is a mesh, a method and a number of vertices. All methods get the same triangulation, samples and
texels, and are measured by the code that measures `flx reconstruct`.
"""

import hashlib
import json
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any, get_args

from tqdm import tqdm

from flx.assets.arrays import sheet_asset
from flx.assets.asset import Asset
from flx.assets.formats.files import read_file
from flx.assets.read import read_asset
from flx.assets.write import write_png
from flx.config import Compared, Comparison
from flx.evaluation import baselines
from flx.evaluation.baselines import Method, Subject
from flx.evaluation.fidelity import fidelity
from flx.evaluation.lpips import HINT, installed_judges
from flx.evaluation.neural_field import intrinsic_field
from flx.files import check_place, write_atomically
from flx.geometry.atlas import with_filled_gutters
from flx.geometry.copies import check_memory, sample_rings
from flx.geometry.remesh.remesh import remesh
from flx.pipeline.canvas import bake, check_size, open_canvas
from flx.pipeline.codec import load_codec
from flx.pipeline.patches import SUFFIXES, image_files
from flx.pipeline.weights import BARYCENTRIC
from flx.stopping import keeping

METHODS = get_args(Compared)
FITTED = ("pca", "frame_pca")  # methods that are fitted to images
SAMPLES = 64  # colours in a one-ring
Row = dict[str, Any]


def reconstruction_table(options: Comparison) -> list[Row]:
    """Measure every method on every mesh at every number of vertices; write table.json and table.md.

    Rows that `options.out` already has for the same contents are kept, and so are those of other meshes,
    methods or numbers of vertices. The table is written after each new row. Returns the rows of `options`.
    `seconds` are the method's own, from samples to texels, including the time it takes to learn a mesh.

    Raises ValueError where there is no mesh, a mesh cannot be read, or a method is unknown.
    """
    out, methods = options.out or Path("evaluation"), list(options.methods)
    check_place(out / "table.json")
    if not options.reconstruction or not options.vertices:
        raise ValueError("there is nothing to evaluate; name meshes after --reconstruction")
    if unknown := [name for name in methods if name not in METHODS]:
        raise ValueError(f"there is no method {unknown[0]!r}; choose from {', '.join(METHODS)}")
    check_memory(max(options.vertices))
    check_size(options.texture_size)
    judges = installed_judges()
    if not judges:
        print(f"flx: {HINT}", file=sys.stderr)
    if options.images is None and any(name in FITTED for name in methods):
        print("flx: skipping pca and frame_pca; pass --images FOLDER to fit them", file=sys.stderr)
        methods = [name for name in methods if name not in FITTED]
    assets = {mesh: _read_asset(mesh) for mesh in options.reconstruction}  # all, before the work begins
    digests, method_named = _digests(methods, options), _methods(options)
    metrics = [judge.metric for judge in judges]

    def key(mesh: str, count: int, name: str) -> str:
        parts = (assets[mesh].digest, count, name, digests[name], options.texture_size, options.seed, metrics)
        return hashlib.sha256(repr(parts).encode()).hexdigest()[:16]

    keys = {cell: key(*cell) for cell in product(options.reconstruction, options.vertices, methods)}
    before = _read(out / "table.json")
    rows = {row["key"]: row for row in before}
    others = [row for row in before if (row["mesh"], row["vertices"], row["method"]) not in keys]

    def finished() -> list[Row]:
        return [rows[k] | {"mesh": cell[0]} for cell, k in keys.items() if k in rows]

    keeping(
        lambda: f"{len(finished())} of {len(keys)} rows are kept in {out}; the same command adds the rest"
    )
    with tqdm(total=len(keys), desc="rows", unit="row", dynamic_ncols=True) as bar:
        bar.update(len(finished()))
        for path, count in product(options.reconstruction, options.vertices):
            missing = [name for name in methods if keys[path, count, name] not in rows]
            if not missing:
                continue
            mesh = with_filled_gutters(assets[path].mesh)
            triangulation = remesh(mesh.vertices, mesh.faces, count, options.seed)
            rings = sample_rings(mesh, triangulation, SAMPLES, options.seed)
            canvas = open_canvas(assets[path], triangulation, options.texture_size)
            for name in missing:
                bar.set_postfix_str(f"{Path(path).name}, {count:,} vertices, {name}")
                method = method_named(name)
                began = time.monotonic()
                baked = bake(canvas, method(Subject(mesh, triangulation, rings)))
                seconds = round(time.monotonic() - began, 2)
                measured = fidelity(canvas.asset, baked, judges, canvas.atlases)
                new = keys[path, count, name]
                row = {"mesh": path, "method": name, "vertices": count, **measured}
                rows[new] = {**row, "seconds": seconds, "key": new}
                if options.atlases and baked.images:
                    write_png(out / f"{Path(path).stem}-{count}-{name}-{new}.png", baked.images[0])
                _write(out, [*finished(), *others])
                bar.update()
    _write(out, [*finished(), *others])
    return finished()


def _read_asset(mesh: str) -> Asset:
    path, _, texture = ("", "", "") if Path(mesh).exists() else mesh.rpartition(":")
    if path:
        return read_asset(Path(path), Path(texture))
    return sheet_asset(Path(mesh)) if Path(mesh).suffix.lower() in SUFFIXES else read_asset(Path(mesh))


def _methods(options: Comparison) -> Callable[[str], Method]:
    """Methods by name, each made at its first use: fitting to images takes a while."""
    images = cache(lambda: baselines.open_images(options.images or Path()))
    makers: dict[str, Callable[[], Method]] = {
        "flvae": lambda: baselines.field_latents(load_codec(options.weights)),
        "barycentric": lambda: baselines.field_latents(load_codec(BARYCENTRIC)),
        "inf": lambda: intrinsic_field,
        "vertex_colours": lambda: baselines.vertex_colours,
        "pca": lambda: baselines.components(images()),
        "frame_pca": lambda: baselines.frame_components(images()),
    }
    return cache(lambda name: makers[name]())


def _digests(methods: Iterable[str], options: Comparison) -> dict[str, str]:
    """A digest of what each method depends on in addition to the mesh: the weights, or the images."""
    digests = dict.fromkeys(methods, "")
    for name, path in (("flvae", options.weights), ("barycentric", BARYCENTRIC)):
        if name in digests:
            digests[name] = load_codec(path).digest()
    if options.images and any(name in FITTED for name in digests):
        content = hashlib.sha256()
        for path in image_files(options.images):
            content.update(read_file(path))
        digests |= {name: content.hexdigest() for name in FITTED if name in digests}
    return digests


# --- the table


def _read(path: Path) -> list[Row]:
    if not path.exists():
        return []
    try:
        rows = json.loads(path.read_bytes())["rows"]
        return [row for row in rows if isinstance(row["key"], str)]
    except (ValueError, KeyError, TypeError):
        message = f"{path} is not a table of flx evaluate; move it away, or give another --out"
        raise ValueError(message) from None


def _write(out: Path, rows: list[Row]) -> None:
    write_atomically(out / "table.json", (json.dumps({"rows": rows}, indent=2) + "\n").encode())
    write_atomically(out / "table.md", markdown(rows).encode())


def means(rows: Sequence[Row]) -> list[Row]:
    """The mean over meshes of every metric, for each method and number of vertices."""
    groups: dict[tuple[str, int], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["method"], row["vertices"]), []).append(row)
    result = []
    for (method, count), group in groups.items():
        shared = [n for n, v in group[0].items() if isinstance(v, float) and all(n in row for row in group)]
        mean = {name: sum(row[name] for row in group) / len(group) for name in shared}
        result.append({"mesh": f"mean of {len(group)}", "method": method, "vertices": count, **mean})
    return result


def markdown(rows: Sequence[Row]) -> str:
    """The rows, then the means, as one Markdown table; what a row lacks stays blank."""
    every = [*rows, *means(rows)]
    columns = list(dict.fromkeys(name for row in every for name in row if name not in ("key", "seconds")))
    columns.append("seconds")
    digits = {"psnr": 2, "seconds": 1}

    def cell(row: Row, name: str) -> str:
        value = row.get(name, "")
        return f"{value:.{digits.get(name, 3)}f}" if isinstance(value, float) else str(value)

    lines = [columns, ["---"] * len(columns), *([cell(row, name) for name in columns] for row in every)]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)
