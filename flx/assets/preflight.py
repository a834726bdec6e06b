"""Checks that the asset can be written, before the work starts, and reports what the new file will lack."""

import os
import sys
from collections.abc import Sequence
from pathlib import Path

from flx.assets.asset import Asset, Format
from flx.assets.conversion import dangling, left_behind
from flx.assets.formats.gltf import Gltf
from flx.assets.formats.obj_source import ObjSource
from flx.assets.write import atlas_files, check_room


def check_output(asset: Asset, format: Format, paths: Sequence[Path], beside: Sequence[Path] = ()) -> None:
    """Checks that the asset can be written to `paths`, with other files `beside` it. Lists on stderr, in one
    line, what the format cannot hold and which files are missing.

    Raises ValueError for a PLY (vertex colours only) of an asset with textures, where files of the asset
    would be overwritten, and where the folder cannot be made or written to.
    """
    for folder in {path.parent for path in paths}:
        existing = next(parent for parent in (folder, *folder.absolute().parents) if parent.exists())
        if not existing.is_dir():
            raise ValueError(f"{existing} is a file; name a folder with --out")
        if not os.access(existing, os.W_OK | os.X_OK):
            raise ValueError(f"{existing} is not writable; name another folder with --out")
    if format == "ply" and asset.textures:
        raise ValueError(f"{asset.path} has textures, a PLY only vertex colours; use --format glb or obj")
    for path in paths:
        check_room(asset, path, [*beside, *atlas_files(asset, path).values()])
    notes = []
    if left := left_behind(asset, format):
        keeping = {ObjSource: "; --format obj keeps all", Gltf: "; --format glb keeps all"}
        notes.append(f"{left} stay behind{keeping.get(type(asset.container), '')}")
    if missing := dangling(asset, format):
        notes.append(f"missing, but named in the new file: {missing}")
    if notes:
        print(f"{asset.path}: {'; '.join(notes)}", file=sys.stderr)
