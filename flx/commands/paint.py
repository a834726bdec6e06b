"""`flx paint`: labels, masks and directions, painted on the surface in a browser."""

import os
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import FlagCreatePairsOff, Positional

if TYPE_CHECKING:
    from flx.assets.asset import Asset
    from flx.viewer.painter import Mode, Painter

USUAL: dict["Mode", str] = {"labels": "labels.png", "keep": "keep.png", "direction": "strokes.json"}


@dataclass(frozen=True)
class Paint:
    """Paint on a mesh in the browser: labels, what is to be kept, or a direction.

    Example: flx paint bowl.glb                what goes where, for flx train --surface.labels labels.png
             flx paint bowl.glb --keep         what stays, for flx sample --keep keep.png
             flx paint bowl.glb --direction    which way it runs, for --surface.direction strokes.json
    """

    mesh: Positional[Path]  # a mesh file with texture coordinates; for --direction any mesh
    labels: FlagCreatePairsOff[bool] = False  # paint labels; so it is if nothing else is asked for
    keep: FlagCreatePairsOff[bool] = False  # paint a mask of what is kept of the one texture
    direction: FlagCreatePairsOff[bool] = False  # draw strokes along which the texture shall run
    start: Path | None = None  # a file to begin with: what was saved, an image of labels, a mask, strokes
    # the file to write: labels.png, keep.png or strokes.json; one that is there only with --start FILE
    out: Path | None = None
    texture: Path | None = None  # an image to use instead of the file's own
    texture_size: int | None = None  # of labels: pixels on the longer side; the texture's, at most 2048
    up: Literal["y", "z"] = "y"  # the axis that points up
    browser: bool = True  # open the page in the browser; without it, the address is printed alone

    def __call__(self) -> None:
        paint(self)


def paint(options: Paint) -> None:
    """Serve the page until it says that it is finished; then print the file.

    Raises ValueError where the mesh cannot be painted so, or a file is there that would be replaced.
    """
    from flx.stopping import keeping
    from flx.viewer.server import open_browser, serving

    painter = opened(options)
    for note in painter.notes:
        print(f"flx: {note}", file=sys.stderr)
    finished = threading.Event()

    def finish(_: bytes) -> tuple[str, bytes]:
        finished.set()
        return "text/plain; charset=utf-8", b"finished"

    keeping(lambda: _said(options, painter))
    with serving({**painter.answers(), ("POST", "finish"): finish}, painter.most) as server:
        print(
            f"flx: paint at {server.url}\nflx: Save and finish there, or Ctrl-C here, ends it",
            file=sys.stderr,
        )
        if options.browser:
            open_browser(server)
        finished.wait()
    print(f"flx: {_said(options, painter)}", file=sys.stderr)
    print(painter.out)


def opened(options: Paint) -> "Painter":
    """The painter that options ask for. Raises ValueError, in one line, for what cannot be painted."""
    from flx.files import check_place
    from flx.pipeline.canvas import atlas_size, check_size
    from flx.viewer.painter import StrokePainter, TexelPainter

    mode = _mode(options)
    out = options.out or Path(USUAL[mode])
    if out.suffix.lower() != Path(USUAL[mode]).suffix:
        raise ValueError(f"--out is {out}; name a {Path(USUAL[mode]).suffix} file")
    check_place(out, "name another file with --out")
    if out.is_dir():
        raise ValueError(f"--out is the folder {out}; name a file")
    if os.path.lexists(out) and not (
        options.start and options.start.exists() and out.samefile(options.start)
    ):
        raise ValueError(
            f"{out} is there already; go on with it by --start {out}, or name another with --out"
        )
    check_size(options.texture_size)
    if options.texture_size is not None and mode != "labels":
        raise ValueError(f"--texture-size is for labels; {USUAL[mode]} has no size of its own")
    asset = _asset(options, mode)
    if mode == "direction":
        return StrokePainter(asset, out, options.up, options.start)
    painted = [n for n, texture in enumerate(asset.textures) if not texture.flat]
    if mode == "keep":
        if len(painted) != 1:
            raise ValueError(f"{asset.path} has {len(painted)} textures; a mask needs exactly one")
        size = asset.mesh.textures[painted[0]].shape[:2]
    else:
        largest = max(asset.mesh.textures, key=lambda image: image.shape[0] * image.shape[1])
        size = atlas_size(largest, options.texture_size)
    return TexelPainter(asset, out, mode, (size[0], size[1]), options.up, options.start)


def _mode(options: Paint) -> "Mode":
    asked: list[Mode] = [mode for mode in USUAL if getattr(options, mode)]
    if len(asked) > 1:
        raise ValueError(f"--{asked[0]} and --{asked[1]} cannot be painted at once; choose one")
    return asked[0] if asked else "labels"


def _asset(options: Paint, mode: "Mode") -> "Asset":
    """The mesh with its own colours; one without colours in white, where no texture is needed."""
    from flx.assets.read import read_asset
    from flx.assets.shape import SHAPES, read_shape
    from flx.assets.unwrap import NEW_CHARTS

    try:
        asset = read_asset(options.mesh, options.texture)
    except ValueError:
        if mode == "keep" or options.texture or options.mesh.suffix.lower() not in SHAPES:
            raise
        asset = read_shape(options.mesh, "ply" if mode == "direction" else "glb")
    if mode != "direction" and (not asset.textures or asset.textures[0].made_from == NEW_CHARTS):
        raise ValueError(
            f"{asset.path} has no texture coordinates to paint on; unwrap it, or give its labels as a PLY's "
            "vertex colours"
        )
    return asset


def _said(options: Paint, painter: "Painter") -> str:
    """What was painted, and what to do with it."""
    if not painter.saved:
        return "nothing was saved"
    file, mesh = painter.out, options.mesh
    use = {
        "labels": f"flx train {mesh} --surface.labels {file}",
        "keep": f"flx sample RUN --keep {file}, or flx sample {mesh} --instant --keep {file}",
        "direction": f"flx train {mesh} --surface.direction {file}",
    }
    return f"{file} is saved ({painter.saved}); next: {use[painter.mode]}"
