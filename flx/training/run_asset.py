"""The asset of a run: read from where the experiment says, and copied whole into the run folder.

`asset/files/` holds the mesh with every file that it needs, `asset/texture/` the image that replaces its own,
`asset/labels/` that of its labels, `asset/direction/` that of its strokes, `asset/fill/` that of its damage.
Reading them gives the same bits as the originals. (Older runs have `asset/asset.glb`.)
"""

import contextlib
import sys
from pathlib import Path

from flx.assets.assemble import faults_of
from flx.assets.asset import Asset
from flx.assets.formats import glb
from flx.assets.formats.files import inside, read_file
from flx.assets.formats.gltf import Gltf
from flx.assets.formats.obj_source import ObjSource, write_copy
from flx.assets.read import read_asset
from flx.assets.vase import vase_asset
from flx.config import Surface
from flx.files import write_atomically
from flx.geometry.atlas import check_repeats
from flx.pipeline.direction import file_of
from flx.pipeline.generator import Source
from flx.training.run import Run


def read_source(surface: Surface) -> Asset:
    """The asset that the experiment names, or the embedded vase.

    Raises ValueError, with the options of `flx train`, for one that cannot be learnt.
    """
    if not surface.path:
        return vase_asset()
    try:
        asset = read_asset(surface.path, surface.texture)
    except ValueError as fault:
        raise ValueError(str(fault).replace("--texture", "--surface.texture")) from fault
    with faults_of(asset.path):
        check_repeats(asset.mesh)
    return asset


def keep(asset: Asset, run: Run, surface: Surface) -> Asset:
    """Copy the asset that `read_source` gave into its run, unless it is there; return the copy.

    A damaged copy is made again, which is said on stderr.
    """
    path, texture = _places(run, surface)
    if path.is_file() and path.parent != run.asset:
        if copy := _same_copy(asset, run, surface):
            return copy
        print(f"{path} is not what was copied there; it is copied again", file=sys.stderr)
        path.unlink()
    if not path.exists():
        if texture is not None:
            write_atomically(texture, read_file(Path(surface.texture or "")))
        if surface.labels:
            write_atomically(labels_in(run, surface), read_file(Path(surface.labels)))
        if surface.fill:
            write_atomically(fill_in(run, surface), read_file(Path(surface.fill)))
        if surface.direction and (strokes := file_of(surface.direction)):
            write_atomically(run.asset / "direction" / strokes.name, read_file(strokes))
        _copy(asset, path, given=texture is not None)  # last: where it is, all is
    return read_copy(run, surface)


def _same_copy(asset: Asset, run: Run, surface: Surface) -> Asset | None:
    """The run's copy, if it is one of this asset."""
    with contextlib.suppress(ValueError, OSError):
        copy = read_copy(run, surface)
        return copy if copy.digest == asset.digest else None


def read_copy(run: Run, surface: Surface) -> Asset:
    """The run's own copy of its asset."""
    return read_asset(*_places(run, surface))


def source_of(run: Run, surface: Surface, asset: Asset) -> Source:
    """The files of the run's copy of its asset, for the generator."""
    mesh, texture = _places(run, surface)
    files = [path for path in run.asset.rglob("*") if path.is_file() and not path.name.startswith(".")]

    def place(path: Path) -> str:
        return path.relative_to(run.asset).as_posix()

    contents = {place(path): read_file(path) for path in sorted(files)}
    labels = place(labels_in(run, surface)) if surface.labels else None
    fill = place(fill_in(run, surface)) if surface.fill else None
    return Source(place(mesh), place(texture) if texture else None, asset.digest, contents, labels, fill)


def labels_in(run: Run, surface: Surface) -> Path:
    """Where the run has its labels, if it has any."""
    return run.asset / "labels" / Path(surface.labels or "").name


def fill_in(run: Run, surface: Surface) -> Path:
    """Where the run has the mask of its damage, if it has any."""
    return run.asset / "fill" / Path(surface.fill or "").name


def direction_in(run: Run, surface: Surface) -> str:
    """The run's direction: a word, or where it has its strokes; "" if it has none."""
    strokes = surface.direction and file_of(surface.direction)
    return str(run.asset / "direction" / strokes.name) if strokes else surface.direction


def _places(run: Run, surface: Surface) -> tuple[Path, Path | None]:
    """Where the run has its mesh, and the texture that replaces the mesh's own."""
    if (old := run.asset / "asset.glb").exists():
        return old, None
    path = run.asset / "files" / (Path(surface.path).name or "vase.glb")
    if path.suffix.lower() == ".gltf":
        path = path.with_suffix(".glb")
    return path, run.asset / "texture" / Path(surface.texture).name if surface.texture else None


def _copy(asset: Asset, path: Path, given: bool) -> None:
    """Copy a mesh with its files: a glTF becomes one GLB, an OBJ or a PLY keeps its files next to it.

    The images of a PLY are needed only where no texture was given.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(asset.container, Gltf):
        write_atomically(path, glb.glb_bytes(asset.container))
    elif isinstance(asset.container, ObjSource):
        write_copy(asset.container, path)
    else:
        for name in [] if given else [texture.name for texture in asset.textures]:
            write_atomically(inside(path.parent, name), read_file(inside(asset.path.parent, name)))
        write_atomically(path, read_file(asset.path))
