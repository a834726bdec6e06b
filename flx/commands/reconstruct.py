"""`flx reconstruct`: a texture through the FL-VAE and back, with its metrics."""

import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from tyro.conf import Positional

from flx.assets.asset import Format
from flx.commands.output import own_folder, settings
from flx.commands.stages import Stages
from flx.config import Surface


@dataclass(frozen=True)
class Reconstruct:
    """Send a texture through the FL-VAE and back, and print its metrics as JSON.

    Example: flx reconstruct bowl.glb --vertices 30000 --out bowl-there-and-back
    """

    mesh: Positional[Path]  # a .glb, .gltf, .obj or .ply file
    vertices: int = 30_000  # of the triangulation that carries the codes
    # folder to write to; else runs/MESH-there-and-back, with the options that are not the usual ones
    out: Path | None = None
    texture: Path | None = None  # an image to use instead of the file's own
    texture_size: int | None = None  # pixels on the longer side; the input's, at most 2048, unless given
    # "glb" keeps everything that a GLB or glTF held, "obj" everything of an OBJ; "ply" holds vertex colours
    format: Format = "glb"
    up: Literal["y", "z"] = "y"  # the axis that points up in the pictures
    weights: str | None = None  # an FL-VAE file; the released one unless given
    seed: int = 0  # of the triangulation
    viewer: bool = True  # write viewer.html: before and after in 3D, one file that needs no network

    def __call__(self) -> None:
        from flx.commands.viewer import name_viewer

        metrics = reconstruct(self)
        print(json.dumps(metrics, indent=2), flush=True)
        if self.viewer:
            name_viewer(Path(metrics["folder"]))


def reconstruct(options: Reconstruct) -> dict[str, Any]:
    """Write the reconstruction, its atlas, pictures, viewer.html and metrics.json; return the metrics."""
    from flx.assets.preflight import check_output
    from flx.assets.read import read_asset
    from flx.assets.unwrap import prepared_for
    from flx.assets.write import write, write_atlases, write_png
    from flx.commands.viewer import write_viewer
    from flx.evaluation.fidelity import fidelity
    from flx.evaluation.lpips import HINT, installed_judges
    from flx.evaluation.timings import peak_bytes
    from flx.files import write_atomically
    from flx.geometry.seams import seam_ratio
    from flx.pipeline.canvas import bake, check_size, open_canvas, shown, side_by_side
    from flx.pipeline.codec import load_codec
    from flx.pipeline.copies import triangulate
    from flx.viewer.page import NAME, shot

    check_size(options.texture_size)
    surface = Surface(vertices=options.vertices, seed=options.seed)
    judges = installed_judges()
    began, stage = time.monotonic(), Stages(4)
    asset = read_asset(options.mesh, options.texture)
    codec = load_codec(options.weights)
    made_by = {**settings(options), "asset": asset.digest, "codec": codec.digest()[:12]}
    usual, name = Path("runs", f"{options.mesh.stem}-there-and-back"), f"reconstruction.{options.format}"
    pictures = ["side_by_side.png", NAME] if options.viewer else ["side_by_side.png"]
    out, _ = own_folder(options, usual, asset.digest[:8], "metrics.json", made_by, [name, *pictures])
    file = out / name
    check_output(asset, options.format, [file], [out / picture for picture in pictures])
    stage(f"triangulating it with {surface.vertices:,} vertices")
    copy = triangulate(asset, surface.vertices, surface.seed, codec.config.samples, surface.slots)
    asset = prepared_for(asset, options.format)
    stage("finding its texels on the triangulation")
    canvas = open_canvas(asset, copy.triangulation, options.texture_size)
    stage("encoding, and decoding every texel")
    baked = bake(canvas, codec.decoder(codec.encode(copy.rings)))
    seconds = time.monotonic() - began

    stage("measuring, writing and picturing it")
    measured = fidelity(asset, baked, judges, canvas.atlases)
    metrics = {
        "mesh": str(options.mesh),
        "folder": str(out),
        **made_by,
        **measured,
        "seam_ratio": seam_ratio(shown(asset, baked)),
        "seam_ratio_input": seam_ratio(asset.mesh),
        "texture_sizes": [list(image.shape[:2]) for image in baked.images],
        "seconds": round(seconds, 2),
        "peak_bytes": peak_bytes(),
    }
    # First: it says whose files these are.
    write_atomically(out / "metrics.json", (json.dumps(metrics, indent=2) + "\n").encode())
    write(asset, baked, file)
    write_atlases(asset, baked, file)
    write_png(out / "side_by_side.png", side_by_side(asset, [baked], ["reconstruction"], options.up, 512))
    if options.viewer:
        shots = [shot("input", asset), shot("reconstruction", asset, baked, name)]
        said = {"mesh": options.mesh, **made_by, **{k: f"{v:.4g}" for k, v in measured.items()}}
        write_viewer(out, f"{options.mesh.name}, there and back", shots, said, options.up)
    if not judges:
        print(f"flx: {HINT}", file=sys.stderr)
    return metrics
