"""Meshes that are hard to remesh, real and made, and what flx makes of each: one Markdown table.

python tests/reports/hard.py [--only NAME ...] [--vertices N] [--out FILE.md]

The real ones lie in the folder named by FLX_DATA; without it there are only the made ones. Each row is
measured in a process of its own: seconds are CPU seconds, MB the most in use after reading, examining,
remeshing and tables, and again after the reconstruction.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import trimesh
from PIL import Image

from flx.commands.reconstruct import Reconstruct, reconstruct
from flx.geometry.repair import topology_counts

sys.path.append(str(Path(__file__).parents[1]))  # a script finds what lies beside it, not helpers
from helpers.oracles import coincidence, distances, min_angles, points_on
from helpers.surfaces import basket, icosphere, moebius, sleeve, soup, square_with_hole, three_touching_boxes

from flx.assets.read import read_asset
from flx.commands.doctor import examine
from flx.config import FLDMExperiment
from flx.evaluation.timings import peak_bytes
from flx.geometry.remesh.remesh import remesh
from flx.geometry.tables import mesh_tables
from flx.types import Triangulation

TEXELS = 1024  # on the longer side of a reconstructed atlas


class Source(NamedTuple):
    mesh: Path
    texture: Path | None


class Case(NamedTuple):
    """A mesh, written into a folder when it is asked for, and the vertices of its copies."""

    build: Callable[[Path], Source]
    vertices: int


# -------------------------------------------------------------------------------------------- made meshes


def coloured(points: np.ndarray, faces: np.ndarray, folder: Path, colors: np.ndarray | None = None) -> Source:
    """A PLY whose colours are waves in space, unless given."""
    if colors is None:
        colors = 0.5 + 0.4 * np.sin(points @ [[5, 1, 0], [0, 4, 2], [3, 0, 5]])
    mesh = trimesh.Trimesh(points, faces, process=False, vertex_colors=np.rint(255 * colors).astype(np.uint8))
    mesh.export(folder / "mesh.ply")
    return Source(folder / "mesh.ply", None)


def thin_cup(folder: Path) -> Source:
    """Walls of a third of an edge, blue inside and red outside."""
    cup = sleeve(0.02)
    return coloured(*soup(cup.vertices, cup.faces), folder, cup.corner_colors.reshape(-1, 3))


def open_scan(folder: Path) -> Source:
    """A rough ball without its foot, with two dozen holes where the scanner saw nothing."""
    rng, (points, faces) = np.random.default_rng(0), icosphere(5)
    points = points * (1 + 0.1 * np.sin(points @ [[3, 5], [7, 2], [1, 6]]).sum(1, keepdims=True))
    points = points * (1 + 0.003 * rng.normal(size=(len(points), 1)))
    holes, radii = points[rng.integers(0, len(points), 24)], rng.uniform(0.02, 0.15, 24)
    middles = points[faces].mean(1)
    seen = (np.linalg.norm(middles[:, None] - holes, axis=2) > radii).all(1) & (middles[:, 2] > -0.7)
    return coloured(points, faces[seen], folder)


def crumbs(folder: Path) -> Source:
    """A sheet with a hole, forty tetrahedra and forty lone triangles, each far smaller than a ring."""
    sheet, rng = square_with_hole(), np.random.default_rng(0)
    points, faces = [sheet.vertices], [sheet.faces]
    kinds = [np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]), np.array([[0, 1, 2]])]
    for corners in [kinds[0]] * 40 + [kinds[1]] * 40:
        place = rng.uniform([0, 0, 0.1], [1, 1, 0.5])
        faces.append(corners + sum(map(len, points)))
        crumb = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])[: corners.max() + 1]
        points.append(0.001 * crumb + place)
    return coloured(np.concatenate(points), np.concatenate(faces), folder)


def million(folder: Path, around: int = 1000, across: int = 500) -> Source:
    """A bumpy torus of 2 · around · across faces, cut open along two seams of its texture coordinates."""
    i, j = (a.ravel() for a in np.meshgrid(np.arange(around + 1), np.arange(across + 1), indexing="ij"))
    turn, roll = 2 * np.pi * (i % around) / around, 2 * np.pi * (j % across) / across
    tube = 0.4 * (1 + 0.05 * np.sin(9 * turn) * np.cos(7 * roll) + 0.01 * np.sin(41 * turn + 3 * roll))
    ring = 1 + tube * np.cos(roll)
    points = np.stack([ring * np.cos(turn), ring * np.sin(turn), tube * np.sin(roll)], 1)
    a = np.flatnonzero((i < around) & (j < across))
    b, c, d = a + across + 1, a + across + 2, a + 1
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    x, y = np.meshgrid(*[np.linspace(0, 2 * np.pi, 1024)] * 2)
    waves = np.stack([np.sin(6 * x) * np.cos(4 * y), np.sin(9 * (x + y)), np.cos(20 * x) * np.sin(7 * y)], -1)
    skin = trimesh.visual.material.PBRMaterial(
        baseColorTexture=Image.fromarray(np.rint(128 + 100 * waves).astype(np.uint8))
    )
    uvs = np.stack([i / around, j / across], 1)
    visual = trimesh.visual.TextureVisuals(uvs, material=skin)
    trimesh.Trimesh(points, faces, process=False, visual=visual).export(folder / "mesh.glb")
    return Source(folder / "mesh.glb", None)


def cases() -> dict[str, Case]:
    """Those of FLX_DATA at the paper's number of vertices, then the made ones."""
    data = Path(os.environ.get("FLX_DATA", os.devnull)) / "meshes"
    real = sorted(data.glob("*/info.json"))
    ball = icosphere(4)
    return {
        **{path.parent.name: Case(partial(_listed, path), 30_000) for path in real},
        "thin cup": Case(thin_cup, 5000),
        "Möbius strip": Case(lambda folder: coloured(*moebius(), folder), 5000),
        "open scan with holes": Case(open_scan, 5000),
        "three touching boxes": Case(lambda folder: coloured(*three_touching_boxes(), folder), 5000),
        "triangle soup": Case(lambda folder: coloured(*soup(*ball), folder), 5000),
        "crumbs smaller than a ring": Case(crumbs, 5000),
        "basket of 192 handles": Case(lambda folder: coloured(*basket(), folder), 5000),
        "two-sided, 1,200 holes": Case(
            lambda folder: coloured(*basket(60, 20, bar=1, hole=3, thickness=0.004), folder), 30_000
        ),
        "million faces": Case(million, 30_000),
    }


def _listed(info: Path, _: Path) -> Source:
    listed = json.loads(info.read_text())
    return Source(info.parent / listed["mesh"], info.parent / listed["texture"])


# ----------------------------------------------------------------------------------------------- measured


class Row(NamedTuple):
    """What a mesh came to; empty after a refusal."""

    verdict: str
    faces: int = 0
    components: int = 0
    loops: int = 0
    vertices: int = 0  # of a copy
    exact: bool = False  # the copy has as many as were asked, and the mesh's components, loops and genus
    low_angle: float = 0.0  # degrees: the 1st percentile of the faces' smallest
    least_angle: float = 0.0
    hausdorff: float = 0.0  # of the diagonal, both ways
    coincidence: float = 0.0  # share of the vertices of two copies
    read_seconds: float = 0.0  # CPU: read, repair, examine
    remesh_seconds: float = 0.0
    table_seconds: float = 0.0
    megabytes: float = 0.0  # most in use until here
    psnr: float = 0.0  # of the texture, through the FL-VAE and back
    reconstruct_megabytes: float = 0.0


def measure(source: Source, vertices: int, out: Path) -> Row:
    """A mesh read, examined, remeshed twice and reconstructed. Raises ValueError where flx refuses it."""
    start = time.process_time()
    asset = read_asset(*source)
    findings = examine(asset, FLDMExperiment())
    read = time.process_time()
    mesh = Triangulation(asset.mesh.vertices, asset.mesh.faces)
    copy = remesh(*mesh, vertices, seed=0)
    remeshed = time.process_time()
    mesh_tables(copy)
    tabled, peak = time.process_time(), peak_bytes() / 2**20

    found, kept = topology_counts(*mesh), topology_counts(*copy)
    exact = len(copy.vertices) == vertices and all(
        getattr(found, name) == getattr(kept, name) for name in ("components", "boundary_loops", "euler")
    )
    angles = min_angles(copy)
    away = max(distances(points_on(copy), mesh).max(), distances(points_on(mesh), copy).max())
    options = Reconstruct(source[0], vertices, out, source.texture, TEXELS)
    fidelity = reconstruct(options)  # loads JAX: not before the geometry's memory is known
    return Row(
        verdict=re.sub(r"flx takes it |[()]", "", findings.verdict),
        faces=len(mesh.faces),
        components=found.components,
        loops=found.boundary_loops,
        vertices=len(copy.vertices),
        exact=exact,
        low_angle=float(np.percentile(angles, 1)),
        least_angle=float(angles.min()),
        hausdorff=float(away / np.linalg.norm(np.ptp(mesh.vertices, axis=0))),
        coincidence=coincidence(copy, remesh(*mesh, vertices, seed=1)),
        read_seconds=read - start,
        remesh_seconds=remeshed - read,
        table_seconds=tabled - remeshed,
        megabytes=peak,
        psnr=fidelity["psnr"],
        reconstruct_megabytes=peak_bytes() / 2**20,
    )


def row_of(name: str, vertices: int | None) -> Row:
    """The row of a case, made in one process and measured in another: neither sees the other's memory."""
    case = cases()[name]
    with TemporaryDirectory() as folder:
        _call("build", name, folder)
        done = _call("measure", name, folder, str(vertices or case.vertices))
    return Row(**json.loads(done.splitlines()[-1]))


def _call(*words: str) -> str:
    done = subprocess.run([sys.executable, __file__, "--step", *words], capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{' '.join(words)}: {done.stderr}")
    return done.stdout


def _step(what: str, name: str, folder: str, vertices: str = "0") -> None:
    case, where = cases()[name], Path(folder) / "source.json"
    if what == "build":
        where.write_text(json.dumps([None if p is None else str(p) for p in case.build(Path(folder))]))
        return
    source = Source(*(p and Path(p) for p in json.loads(where.read_text())))
    try:
        row = measure(source, int(vertices), Path(folder) / "out")
    except ValueError as refusal:
        row = Row(f"refused: {refusal}")
    print(json.dumps(row._asdict()))


HEADER = (
    *("mesh", "doctor", "faces", "components", "loops", "vertices", "exact", "1 % angle", "least angle"),
    *("Hausdorff, % of diagonal", "coincidence %", "read s", "remesh s", "tables s", "MB"),
    *("PSNR dB", "MB with JAX"),
)


def line(name: str, row: Row) -> str:
    """One row of the table, in Markdown."""
    if not row.vertices:
        return f"| {name} | {row.verdict} |" + " |" * (len(HEADER) - 2)
    cells: tuple[Any, ...] = (
        *(name, row.verdict, f"{row.faces:,}", row.components, row.loops),
        *(f"{row.vertices:,}", "yes" if row.exact else "NO"),
        *(f"{row.low_angle:.1f}°", f"{row.least_angle:.1f}°"),
        *(f"{100 * row.hausdorff:.2f}", f"{100 * row.coincidence:.1f}"),
        *(f"{row.read_seconds:.1f}", f"{row.remesh_seconds:.1f}", f"{row.table_seconds:.1f}"),
        *(f"{row.megabytes:.0f}", f"{row.psnr:.1f}", f"{row.reconstruct_megabytes:.0f}"),
    )
    return f"| {' | '.join(map(str, cells))} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", default=list(cases()), choices=list(cases()), metavar="NAME")
    parser.add_argument("--vertices", type=int, help="of each copy; 30,000 of real meshes, else 5,000")
    parser.add_argument("--out", type=Path, help="a file for the table, beside standard output")
    parser.add_argument("--step", nargs="+", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.step:
        return _step(*arguments.step)
    lines = [f"| {' | '.join(HEADER)} |", "|---" * len(HEADER) + "|"]
    print(*lines, sep="\n")
    for name in arguments.only:
        lines.append(line(name, row_of(name, arguments.vertices)))
        print(lines[-1], flush=True)
    if arguments.out:
        arguments.out.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
