"""What every format is read into: parts, materials, and the look of a material."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from jaxtyping import Float32, Float64, Int

from flx.types import Slot

# What a material without an image has, as an image stores it: a flat normal, no metal, no light of its own.
NEUTRAL: dict[Slot, tuple[float, float, float]] = {
    "normal": (0.5, 0.5, 1.0),
    "metallic_roughness": (1.0, 1.0, 0.0),
    "occlusion": (1.0, 1.0, 1.0),
    "emissive": (0.0, 0.0, 0.0),
}


class Part(NamedTuple):
    """The triangles of one material, as the file holds them: what every format is read into."""

    name: str
    material: int  # index into the materials of the asset
    positions: Float64[Any, "V 3"]  # in the scene: node transforms applied
    normals: Float64[Any, "V 3"] | None  # in the scene, too
    uvs: Float64[Any, "V 2"] | None  # right and down
    colors: Float32[Any, "V 3"] | None  # sRGB
    faces: Int[Any, "F 3"]
    origin: tuple[int, int] = (-1, -1)  # glTF: node, primitive


class Material(NamedTuple):
    """A material as a file states it; `image` is what the file calls its base colour image."""

    name: str
    color: tuple[float, float, float]  # sRGB
    image: str | None
    opacity: float = 1.0
    opacity_image: str | None = None  # whose alpha counts
    maps: Mapping[Slot, str] = {}  # what the file calls the images of other slots
    flat: Mapping[Slot, tuple[float, float, float]] = {}  # of other slots, if not `NEUTRAL`

    def flat_value(self, slot: Slot) -> tuple[float, float, float]:
        """What the material has all over where it has no image, as an image would store it."""
        return self.color if slot == "base_color" else self.flat.get(slot, NEUTRAL[slot])


class Paint(NamedTuple):
    """What a material looks like: the index of its image in each slot, or a flat sRGB colour."""

    name: str
    textures: Mapping[Slot, int]
    color: tuple[float, float, float]
    opacity: float = 1.0
    alpha_mode: str = "OPAQUE"  # as glTF names them; of a glTF itself the container knows

    @property
    def texture(self) -> int:
        """The index of its base colour image; −1: none."""
        return self.textures.get("base_color", -1)
