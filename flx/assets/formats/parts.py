"""What every format is read into: parts, materials, and the look of a material."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int

from flx.types import Faces, Slot

# The values of a material without an image, as an image stores them: a flat normal, no metal, no emission.
NEUTRAL: dict[Slot, tuple[float, float, float]] = {
    "normal": (0.5, 0.5, 1.0),
    "metallic_roughness": (1.0, 1.0, 0.0),
    "occlusion": (1.0, 1.0, 1.0),
    "emissive": (0.0, 0.0, 0.0),
}


class Part(NamedTuple):
    """The triangles of one material, as the file holds them."""

    name: str
    material: int  # index into the materials of the asset
    positions: Float64[Any, "V 3"]  # in the scene: node transforms applied
    normals: Float64[Any, "V 3"] | None  # likewise
    uvs: Float64[Any, "V 2"] | None  # right and down
    colors: Float32[Any, "V 3"] | None  # sRGB
    faces: Faces
    origin: tuple[int, int] = (-1, -1)  # glTF: node, primitive

    def at(self, rows: Int[Any, "R"], faces: Faces) -> "Part":
        """Some rows of the part, with faces that count among them."""
        arrays = {name: getattr(self, name) for name in ("positions", "normals", "uvs", "colors")}
        chosen = {name: None if array is None else array[rows] for name, array in arrays.items()}
        return self._replace(**chosen, faces=faces)


def stacked(parts: Sequence[Part]) -> tuple[Float64[Any, "V 3"], list[Int[Any, "F 3"]]]:
    """The positions of all parts in turn, and the faces of each part with rows counted through the parts."""
    starts = np.cumsum([0, *(len(part.positions) for part in parts)])[:-1]
    faces = [part.faces + start for part, start in zip(parts, starts, strict=True)]
    return np.concatenate([part.positions for part in parts]), faces


class Material(NamedTuple):
    """A material as a file states it; `image` is what the file calls its base colour image."""

    name: str
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)  # sRGB
    image: str | None = None
    opacity: float = 1.0
    opacity_image: str | None = None  # the image whose alpha is used
    maps: Mapping[Slot, str] = {}  # what the file calls the images of other slots
    flat: Mapping[Slot, tuple[float, float, float]] = {}  # values of other slots, if not `NEUTRAL`
    # In an MTL: texture coordinates are `scale`·uv + `offset`, with v upwards.
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)
    moved: frozenset[Slot] = frozenset()  # other slots whose image has a scale or offset
    options: tuple[str, ...] = ()  # of map_Kd that are not applied

    @property
    def is_placed(self) -> bool:
        """Whether `scale` or `offset` changes the texture coordinates."""
        return (self.scale, self.offset) != ((1.0, 1.0), (0.0, 0.0))

    def flat_value(self, slot: Slot) -> tuple[float, float, float]:
        """The value all over a material without an image in this slot, as an image would store it."""
        return self.color if slot == "base_color" else self.flat.get(slot, NEUTRAL[slot])


class Paint(NamedTuple):
    """What a material looks like: the index of its image in each slot, or a flat sRGB colour."""

    name: str
    textures: Mapping[Slot, int]
    color: tuple[float, float, float]
    opacity: float = 1.0
    alpha_mode: str = "OPAQUE"  # in glTF's words; for a file that was glTF, its container decides

    @property
    def texture(self) -> int:
        """The index of the base colour image, −1 without one."""
        return self.textures.get("base_color", -1)
