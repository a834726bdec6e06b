"""Reads a textured mesh file into an `Asset`, or raises an error of one line that names the fault."""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from flx.arguments import check_word, path_of
from flx.assets.assemble import assemble, faults_of
from flx.assets.asset import Asset
from flx.assets.formats.files import BadFile
from flx.assets.formats.gltf import Gltf
from flx.assets.formats.readers import READERS, Contents, Reader
from flx.types import SLOTS, Slot

BARE = " with colours: it holds triangles alone; paint it with `flx sample RUN --mesh`, or export it as GLB"
OTHERS = {".stl": BARE, ".off": BARE}
OTHERS |= dict.fromkeys(
    (".fbx", ".blend", ".dae", ".usd", ".usda", ".usdc", ".usdz", ".3ds", ".max", ".ma", ".mb"),
    " that flx reads; export it as GLB",
)


def read_asset(
    path: str | Path, texture: str | Path | None = None, slots: Sequence[Slot] = ("base_color",)
) -> Asset:
    """Read a mesh file, repair it as far as needed, and count every repair in `asset.report`.

    Args:
        path: A .glb, .gltf, .obj or .ply file.
        texture: An image to use instead of the file's one base colour image, or where it has none.
        slots: The maps to read. The base colour is always read; "normal", "metallic_roughness", "occlusion"
            and "emissive" only where they are named here.

    Raises FileNotFoundError, or ValueError for a file without triangles or colour, with an unreadable part,
    without a map in one of the slots, or with more than one image for `texture` to replace.

    Example:
        asset = flx.load("bowl.obj", texture="bowl.png")
        print(asset.report.vertices, asset.report.textures)
    """
    path = path_of("path", path, "a mesh file, such as 'bowl.glb'")
    if texture is not None:
        texture = path_of("texture", texture, "an image file, such as 'bowl.png'")
    if isinstance(slots, str):
        raise ValueError(f"slots is {slots!r}; give a list, [{slots!r}]")
    for slot in slots:
        check_word("slots", slot, SLOTS)
    contents = read_contents(path)
    with faults_of(path):
        return assemble(path, contents, texture, slots)


def read_with_maps(path: Path, texture: Path | None = None) -> Asset:
    """`read_asset` with all maps of a glTF or GLB; those that cannot be read are left out, as stderr says."""
    asset = read_asset(path, texture)
    if not isinstance(asset.container, Gltf):
        return asset
    others: list[Slot] = [s for s in SLOTS if s != "base_color" and asset.map_names.get(s)]
    try:
        return read_asset(path, texture, others)
    except (OSError, ValueError):
        readable: list[Slot] = []  # find out which
    for slot in others:
        try:
            asset = read_asset(path, texture, [*readable, slot])
        except (OSError, ValueError) as fault:
            print(f"{fault}; its {slot} map stays as it is", file=sys.stderr)
        else:
            readable.append(slot)
    return asset


def read_contents(path: Path, readers: Mapping[str, Reader] = READERS) -> Contents:
    """A mesh file, not yet checked, by the reader for its suffix. Raises as `read_asset` does."""
    reader = readers.get(path.suffix.lower())
    try:
        if not path.exists():
            raise FileNotFoundError(f"{path} does not exist; name a mesh file ({', '.join(readers)})")
        if reader is None or not path.is_file():
            what = OTHERS.get(path.suffix.lower(), f"; give one of {', '.join(readers)}")
            raise ValueError(f"{path} is not a mesh file{what}")
        if path.stat().st_size == 0:
            raise ValueError(f"{path} is empty; export it again")
    except OSError as fault:
        if isinstance(fault, FileNotFoundError):
            raise
        raise ValueError(f"{str(path)[:80]} cannot be opened ({fault.strerror}); give a mesh file") from fault
    with faults_of(path):
        try:
            return reader(path)
        except (BadFile, OSError):
            raise
        except Exception as fault:  # unforeseen, in a parser
            what = " ".join(f"{type(fault).__name__}: {fault}".split())[:200]
            raise ValueError(f"cannot be read ({what}); export it again") from fault
