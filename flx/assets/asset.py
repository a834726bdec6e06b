"""A mesh file in memory: `Asset` as it was read, `Report` of its repairs, a `Painting` to write back."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float32, Int, UInt, UInt8

from flx.arguments import check_kind
from flx.assets.formats.gltf import Gltf
from flx.assets.formats.obj_source import ObjSource
from flx.assets.formats.parts import Paint, Part
from flx.types import Slot, TexturedMesh


class Texture(NamedTuple):
    """What belongs to an image of the mesh in addition to its RGB pixels."""

    name: str
    alpha: UInt8[Any, "H W"] | None
    flat: bool  # made from a material's colour: never replaced
    made_from: str = ""  # its original kind, unless 8-bit RGB: "16-bit grey"
    turned: bool = False  # EXIF data say so, which browsers do and flx does not: see formats/images.py


class Report(NamedTuple):
    """The contents of the file and its repairs, in plain numbers and words for JSON (`_asdict`)."""

    path: str
    format: str
    parts: int
    materials: int
    vertices_read: int  # rows; of an OBJ, distinct combinations of v, vt and vn
    faces_read: int
    polygons: int  # faces of more than three corners, cut into fans
    welded_vertices: int
    degenerate_faces: int
    ear_faces: int
    duplicate_faces: int
    unused_vertices: int
    nonmanifold_edges: int
    disagreeing_edges: int
    nonmanifold_vertices: int
    split_vertices: int
    vertices: int
    faces: int
    components: int
    boundary_edges: int
    boundary_loops: int
    euler: int
    sliver_faces: int
    flat_uv_faces: int  # no area on the texture
    outside_uv_faces: int  # a corner outside [0, 1]: the texture repeats there
    color_source: str  # "texture" or "vertex colours"
    textures: tuple[str, ...]
    missing_images: tuple[str, ...]  # missing or not copied; the file's reference is kept as it is
    ignored_options: tuple[str, ...]  # of map_Kd; kept as they are
    found_images: tuple[str, ...]  # found under another name: the file has another path or capitalisation
    unread: tuple[str, ...]  # properties, elements and comments of a PLY that flx does not use


class Asset(NamedTuple):
    """A mesh to work on, and everything needed to write its file again with other maps."""

    path: Path
    mesh: TexturedMesh
    report: Report
    parts: tuple[Part, ...]
    paints: tuple[Paint, ...]  # by `Part.material`
    sources: Mapping[Slot, tuple[Texture, ...]]  # one for each image of `mesh.maps`
    map_names: Mapping[Slot, tuple[str, ...]]  # the file's names of images in other slots, read or not
    corner_vertices: Int[Any, "F 3"]  # the original vertex of each corner, counted through the parts
    container: Gltf | ObjSource | None  # the file, if it was GLB, glTF or OBJ
    digest: str  # SHA-256 of geometry and colours, and of other maps that were read

    @property
    def textures(self) -> tuple[Texture, ...]:
        """One for each of `mesh.textures`, the base colour images."""
        return self.sources["base_color"]


Format = Literal["glb", "obj", "ply"]
Images = Sequence[UInt[Any, "_ _ 3"]]


class Painting(NamedTuple):
    """New maps of an asset: an image of 8 or 16 bits for each of its own in some slots; or vertex colours.

    Slots that are left out keep their images.
    """

    maps: Mapping[Slot, Images]
    colors: Float32[Any, "V 3"] = np.zeros((0, 3), np.float32)

    @property
    def images(self) -> Images:
        """The base colour images."""
        return self.maps.get("base_color", ())


def check_asset(name: str, asset: object) -> None:
    """Raises ValueError where an argument is not an asset."""
    check_kind(name, asset, Asset, 'an Asset, such as flx.load("bowl.glb") returns')


def check_painting(name: str, painting: object) -> None:
    """Raises ValueError where an argument is not a painting, or has a colour that is not a number."""
    check_kind(name, painting, Painting, "a Painting, such as flx.paint returns")
    colors = painting.colors  # pyright: ignore[reportAttributeAccessIssue]
    if not np.isfinite(colors).all():
        row = int((~np.isfinite(colors)).any(1).argmax())
        raise ValueError(f"{name}.colors[{row}] is {colors[row].tolist()}; give numbers from 0 to 1")


def own_painting(asset: Asset) -> Painting:
    """The asset's own images in the slots that were read, or the colours of its original vertices."""
    colors = np.zeros((asset.report.vertices_read, 3), np.float32)  # black where repair dropped all faces
    colors[asset.corner_vertices.ravel()] = asset.mesh.corner_colors.reshape(-1, 3)
    return Painting({slot: layer.images for slot, layer in asset.mesh.maps.items() if layer.images}, colors)
