"""Variations of another folder, to be shown beside new ones."""

import json
from pathlib import Path

import numpy as np

from flx.assets.asset import Asset, Painting, own_painting

MOST = 8  # variations shown of that folder


def beside(folder: Path, asset: Asset) -> dict[str, Painting]:
    """Variations of the asset that another call wrote to a folder, by the captions that they get.

    Raises ValueError where the folder has none, or those of another mesh.
    """
    from flx.assets.read import read_asset

    try:
        record = json.loads((folder / "samples.json").read_text())
        files = [folder / name for name in record["files"]][:MOST]
        kind = "instant" if record.get("method") == "instant" else folder.name
    except (OSError, ValueError, KeyError, TypeError):
        files = []
    if not files:
        raise ValueError(
            f"beside {folder}: no variations are there; name a folder that `flx sample` wrote to"
        )
    found: dict[str, Painting] = {}
    for number, file in enumerate(files):
        other = read_asset(file)
        if not same_surface(asset, other):
            raise ValueError(f"beside {folder}: {file.name} is not {asset.path.name} with other colours")
        found[f"{kind} {number:02d}"] = own_painting(other)
    return found


def same_surface(asset: Asset, other: Asset) -> bool:
    """Whether two assets have the same triangles and texture coordinates, whatever their colours."""
    if asset.mesh.faces.shape != other.mesh.faces.shape or len(asset.textures) != len(other.textures):
        return False
    corners, others = (each.mesh.vertices[each.mesh.faces] for each in (asset, other))
    size = np.ptp(asset.mesh.vertices, axis=0).max()
    near = np.abs(corners - others).max() < 1e-4 * size
    return bool(
        near and (not asset.textures or np.abs(asset.mesh.corner_uvs - other.mesh.corner_uvs).max() < 1e-4)
    )
