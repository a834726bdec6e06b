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
from flx.assets.read import read_asset
from flx.assets.write import write_png
from flx.config import Compared
from flx.evaluation.baselines import (
    Method,
    Subject,
    components,
    field_latents,
    frame_components,
    open_images,
    vertex_colours,
)
from flx.evaluation.fidelity import fidelity
from flx.evaluation.lpips import HINT, installed_judges
from flx.evaluation.neural_field import intrinsic_field
from flx.files import write_atomically
from flx.geometry.atlas import with_filled_gutters
from flx.geometry.copies import sample_rings
from flx.geometry.remesh.remesh import remesh
from flx.pipeline.canvas import check_size, chunks, open_canvas, painted
from flx.pipeline.codec import BARYCENTRIC, load_codec
from flx.pipeline.patches import SUFFIXES

METHODS = get_args(Compared)
FITTED = ("pca", "frame_pca")  # to images
SAMPLES = 64  # colours a one-ring
Row = dict[str, Any]


def reconstruction_table(
    meshes: Sequence[str],
    vertices: Sequence[int],
    methods: Sequence[str],
    images: Path | None,
    weights: str | None,
    texture_size: int | None,
    seed: int,
    out: Path,
    atlases: bool = False,
) -> list[Row]:
    """Measure every method on every mesh at every number of vertices; write table.json and table.md.

    Rows that `out` already has for the same contents are kept, and so are those of other meshes, methods or
    numbers of vertices. The table is written after each new row. Returned are the rows that were asked for.
    `seconds` are the method's own, from samples to texels, learning included where it learns a mesh.

    A mesh whose file names no texture is given as MESH:TEXTURE; an image is laid on a flat sheet.
    `atlases`: write the first new texture of each new row too.

    Raises ValueError where there is no mesh, a mesh cannot be read, or a method is unknown.
    """
    if not meshes or not vertices:
        raise ValueError("there is nothing to evaluate; name meshes after --reconstruction")
    if unknown := [name for name in methods if name not in METHODS]:
        raise ValueError(f"there is no method {unknown[0]!r}; say some of {', '.join(METHODS)}")
    check_size(texture_size)
    judges = installed_judges()
    if not judges:
        print(f"flx: {HINT}", file=sys.stderr)
    if images is None and any(name in FITTED for name in methods):
        print("flx: pca and frame_pca are left out: they are fitted to --images FOLDER", file=sys.stderr)
        methods = [name for name in methods if name not in FITTED]
    assets = {mesh: _read_asset(mesh) for mesh in meshes}  # all are read before the work begins
    made_of, makers = _contents(methods, images, weights), _Makers(images, weights)
    metrics = [judge.metric for judge in judges]

    def key(mesh: str, count: int, name: str) -> str:
        parts = (assets[mesh].digest, count, name, made_of[name], texture_size, seed, metrics)
        return hashlib.sha256(repr(parts).encode()).hexdigest()[:16]

    wanted = {cell: key(*cell) for cell in product(meshes, vertices, methods)}
    before = _read(out / "table.json")
    found = {row["key"]: row for row in before}
    others = [row for row in before if (row["mesh"], row["vertices"], row["method"]) not in wanted]

    def asked() -> list[Row]:
        return [found[k] | {"mesh": cell[0]} for cell, k in wanted.items() if k in found]

    with tqdm(total=len(wanted), desc="rows", unit="row", dynamic_ncols=True) as bar:
        bar.update(len(asked()))
        for path, count in product(meshes, vertices):
            missing = [name for name in methods if wanted[path, count, name] not in found]
            if not missing:
                continue
            mesh = with_filled_gutters(assets[path].mesh)
            triangulation = remesh(mesh.vertices, mesh.faces, count, seed)
            rings = sample_rings(mesh, triangulation, SAMPLES, seed)
            canvas = open_canvas(assets[path], triangulation, texture_size)
            for name in missing:
                method = makers[name]
                began = time.monotonic()
                baked = painted(canvas, map(method(Subject(mesh, triangulation, rings)), chunks(canvas)))
                seconds = round(time.monotonic() - began, 2)
                measured = fidelity(canvas.asset, baked, judges, canvas.atlases)
                new = wanted[path, count, name]
                row = {"mesh": path, "method": name, "vertices": count, **measured}
                found[new] = {**row, "seconds": seconds, "key": new}
                if atlases and baked.images:
                    write_png(out / f"{Path(path).stem}-{count}-{name}-{new}.png", baked.images[0])
                _write(out, [*asked(), *others])
                bar.update()
    _write(out, [*asked(), *others])
    return asked()


def _read_asset(mesh: str) -> Asset:
    path, _, texture = ("", "", "") if Path(mesh).exists() else mesh.rpartition(":")
    if path:
        return read_asset(Path(path), Path(texture))
    return sheet_asset(Path(mesh)) if Path(mesh).suffix.lower() in SUFFIXES else read_asset(Path(mesh))


class _Makers(dict[str, Method]):
    """Methods, each made when it is first asked for: fitting to images takes a while."""

    def __init__(self, images: Path | None, weights: str | None) -> None:
        opened = cache(lambda: open_images(images or Path()))
        self.makers: dict[str, Callable[[], Method]] = {
            "flvae": lambda: field_latents(load_codec(weights)),
            "barycentric": lambda: field_latents(load_codec(BARYCENTRIC)),
            "inf": lambda: intrinsic_field,
            "vertex_colours": lambda: vertex_colours,
            "pca": lambda: components(opened()),
            "frame_pca": lambda: frame_components(opened()),
        }

    def __missing__(self, name: str) -> Method:
        self[name] = self.makers[name]()
        return self[name]


def _contents(methods: Iterable[str], images: Path | None, weights: str | None) -> dict[str, str]:
    """What each method's answers hang on beside the mesh: the weights, or the images."""
    contents = dict.fromkeys(methods, "")
    if "flvae" in contents:
        contents["flvae"] = load_codec(weights).digest()
    if "barycentric" in contents:
        contents["barycentric"] = load_codec(BARYCENTRIC).digest()
    if images and any(name in FITTED for name in contents):
        seen = hashlib.sha256()
        for path in sorted(p for p in images.rglob("*") if p.suffix.lower() in SUFFIXES):
            seen.update(path.read_bytes())
        contents |= dict.fromkeys((name for name in FITTED if name in contents), seen.hexdigest())
    return contents


# --- the table


def _read(path: Path) -> list[Row]:
    if not path.exists():
        return []
    try:
        rows = json.loads(path.read_bytes())["rows"]
        return [row for row in rows if isinstance(row["key"], str)]
    except (ValueError, KeyError, TypeError):
        raise ValueError(
            f"{path} is not a table of flx evaluate; move it away, or take another --out"
        ) from None


def _write(out: Path, rows: list[Row]) -> None:
    write_atomically(out / "table.json", (json.dumps({"rows": rows}, indent=2) + "\n").encode())
    write_atomically(out / "table.md", markdown(rows).encode())


def means(rows: Sequence[Row]) -> list[Row]:
    """The mean over meshes of every metric, for each method and number of vertices."""
    groups: dict[tuple[str, int], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["method"], row["vertices"]), []).append(row)
    return [
        {"mesh": f"mean of {len(group)}", "method": method, "vertices": count, **_mean(group)}
        for (method, count), group in groups.items()
    ]


def _mean(rows: Sequence[Row]) -> dict[str, float]:
    shared = [n for n in rows[0] if isinstance(rows[0][n], float) and all(n in row for row in rows)]
    return {name: sum(row[name] for row in rows) / len(rows) for name in shared}


def markdown(rows: Sequence[Row]) -> str:
    """The rows, then the means, as one Markdown table; what a row lacks is left blank."""
    every = [*rows, *means(rows)]
    columns = list(dict.fromkeys(name for row in every for name in row if name not in ("key", "seconds")))
    columns.append("seconds")
    digits = {"psnr": 2, "seconds": 1}

    def cell(row: Row, name: str) -> str:
        value = row.get(name, "")
        return f"{value:.{digits.get(name, 3)}f}" if isinstance(value, float) else str(value)

    lines = [columns, ["---"] * len(columns), *([cell(row, name) for name in columns] for row in every)]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)
