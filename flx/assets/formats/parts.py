"""What every format is read into: parts, materials, and the look of a material."""

from typing import Any, NamedTuple

from jaxtyping import Float32, Float64, Int


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


class Paint(NamedTuple):
    """What a material looks like: the index of a texture, or −1 and a flat sRGB colour."""

    name: str
    texture: int
    color: tuple[float, float, float]
    opacity: float = 1.0
    alpha_mode: str = "OPAQUE"  # as glTF names them; of a glTF itself the container knows
