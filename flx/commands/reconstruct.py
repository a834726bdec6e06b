"""`flx reconstruct`: a texture through the FL-VAE and back, with its metrics."""

import json
import sys
import time
from pathlib import Path
from typing import Any

from flx.assets.asset import Format
from flx.assets.preflight import check_output
from flx.assets.read import read_asset
from flx.assets.unwrap import prepared_for
from flx.assets.write import write, write_atlases, write_png
from flx.commands.bench import peak_bytes
from flx.config import Surface
from flx.evaluation.fidelity import fidelity
from flx.evaluation.lpips import HINT, installed_judges
from flx.files import write_atomically
from flx.geometry.atlas import with_filled_gutters
from flx.geometry.copies import make_copy
from flx.geometry.seams import seam_ratio
from flx.pipeline.canvas import bake, check_size, open_canvas, shown, side_by_side
from flx.pipeline.codec import load_codec


def reconstruct(
    mesh: Path,
    vertices: int = 30_000,
    texture: Path | None = None,
    texture_size: int | None = None,
    weights: str | None = None,
    seed: int = 0,
    up: str = "y",
    out: Path | None = None,
    format: Format = "glb",
) -> dict[str, Any]:
    """Send a mesh's texture through the FL-VAE and back onto its own coordinates; return the metrics.

    Writes the reconstruction, its atlas, side_by_side.png and metrics.json into `out`.
    """
    check_size(texture_size)
    judges = installed_judges()
    began = time.monotonic()
    asset = read_asset(mesh, texture)
    out = out or Path(f"{mesh.stem}-{vertices}")
    check_output(asset, format, [out / f"reconstruction.{format}"], [out / "side_by_side.png"])
    codec = load_codec(weights)
    surface = Surface(vertices=vertices, seed=seed)
    copy = make_copy(with_filled_gutters(asset.mesh), vertices, codec.config.samples, surface.slots, seed)
    asset = prepared_for(asset, format)
    canvas = open_canvas(asset, copy.triangulation, texture_size)
    baked = bake(canvas, codec, codec.encode(copy.rings))
    seconds = time.monotonic() - began

    metrics = {
        "mesh": str(mesh),
        "vertices": vertices,
        **fidelity(canvas, baked, judges),
        "seam_ratio": seam_ratio(shown(asset, baked)),
        "seam_ratio_input": seam_ratio(asset.mesh),
        "texture_sizes": [list(image.shape[:2]) for image in baked.images],
        "seconds": round(seconds, 2),
        "peak_bytes": peak_bytes(),
    }
    write(asset, baked, out / f"reconstruction.{format}")
    write_atlases(asset, baked, out / f"reconstruction.{format}")
    write_png(out / "side_by_side.png", side_by_side(asset, [baked], ["reconstruction"], up, 512))
    write_atomically(out / "metrics.json", (json.dumps(metrics, indent=2) + "\n").encode())
    if not judges:
        print(f"flx: {HINT}", file=sys.stderr)
    return metrics
