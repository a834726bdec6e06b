"""The data that passes from NumPy geometry to JAX networks, and its conventions.

Letters in shapes: V vertices, F faces, K ring slots, S samples, C channels, D latent channels,
W coarse vertices, M children slots, P points on the surface. A batch of mesh copies is a leading axis.

- A tangent vector is complex64 in its own vertex's frame; angles run counter-clockwise about the outward
  normal. The frame's x axis is the first edge of the vertex's ordered one-ring: intrinsic, no embedding.
- Directions are unit complex numbers, never angles.
- Lengths are in mean vertex radii, r̄ = √(area / (π V)), of the level they belong to.
- p receives, q is its neighbour; P_{p←q} transports a vector at q to p by multiplication.
- Padding is inert: a spare slot points at its own row with weight 0, log 0 and transport 1; a spare vertex
  has mass 0. Slot 0 of a ring is the vertex itself (log 0, transport 1). No function carries a mask.
- Colours are sRGB in [0, 1]. Texture coordinates run right and down (glTF): u·W − ½, v·H − ½ is a pixel.

Arrays are NumPy or JAX, hence `Any`; importing this module loads neither jax nor flax.
"""

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple, get_args

from jaxtyping import Complex64, Float32, Float64, Int, Int32, UInt

Slot = Literal["base_color", "normal", "metallic_roughness", "occlusion", "emissive"]  # as in glTF
SLOTS: tuple[Slot, ...] = get_args(Slot)
Vertices = Float64[Any, "V 3"]  # positions
Faces = Int[Any, "F 3"]  # their vertices, counter-clockwise seen from outside


class Layer(NamedTuple):
    """The images of one slot, and where each corner reads them.

    All have three channels of 8 or 16 bits, also where glTF uses fewer: roughness is green and metallic blue,
    occlusion red. A material without an image has a small one of its flat value.
    """

    images: tuple[UInt[Any, "_ _ 3"], ...]
    face_images: Int[Any, "F"]  # index into `images`
    corner_uvs: Float64[Any, "F 3 2"]  # may leave [0, 1]: the texture repeats


class TexturedMesh(NamedTuple):
    """A repaired triangle mesh, the colour of every point on it, and any other maps that were read.

    There always is a layer of base colours. If it has no images, colour comes from `corner_colors`.
    """

    vertices: Vertices  # in the file's units
    faces: Faces  # counter-clockwise seen from outside
    maps: Mapping[Slot, Layer]
    corner_colors: Float32[Any, "F 3 3"]  # zeros if the mesh has base colour images

    @property
    def textures(self) -> tuple[UInt[Any, "_ _ 3"], ...]:
        """The base colour images."""
        return self.maps["base_color"].images

    @property
    def face_textures(self) -> Int[Any, "F"]:
        return self.maps["base_color"].face_images

    @property
    def corner_uvs(self) -> Float64[Any, "F 3 2"]:
        return self.maps["base_color"].corner_uvs

    def with_layer(self, slot: Slot = "base_color", **changes: Any) -> "TexturedMesh":
        """The mesh with some fields of one layer changed."""
        return self._replace(maps={**self.maps, slot: self.maps[slot]._replace(**changes)})


def is_srgb(slot: Slot) -> bool:
    """Whether a slot's images are sRGB; the others hold linear numbers (glTF 2.0, section 3.9.2)."""
    return slot in ("base_color", "emissive")


class Triangulation(NamedTuple):
    """One remeshed copy of a surface: a manifold, oriented triangle mesh, open or closed."""

    vertices: Vertices
    faces: Faces


class OneRings(NamedTuple):
    """Padded one-rings: what a field convolution gathers."""

    neighbors: Int32[Any, "*B V K"]
    reverse: Int32[Any, "*B V K"]  # the slot of p in the ring of its k-th neighbour; spare and 0: k itself
    logs: Complex64[Any, "*B V K"]  # log_p q
    transports: Complex64[Any, "*B V K"]  # P_{p←q}
    weights: Float32[Any, "*B V K"]  # masses of the ring, normalised to sum 1
    masses: Float32[Any, "*B V"]  # share of the surface, sums to 1


class Pooling(NamedTuple):
    """Clusters of fine vertices. A coarse vertex IS a fine vertex and keeps its frame."""

    centers: Int32[Any, "*B W"]  # the fine vertex that each coarse vertex is
    parents: Int32[Any, "*B V"]  # the coarse vertex of each fine one
    transports: Complex64[Any, "*B V"]  # P_{parent←v}
    children: Int32[Any, "*B W M"]  # fine vertices of each cluster; spare: the centre, with weight 0
    child_transports: Complex64[Any, "*B W M"]  # P_{cluster←child}
    child_weights: Float32[Any, "*B W M"]  # masses of the cluster, normalised to sum 1


class MeshTables(NamedTuple):
    """Everything the denoiser knows about a mesh copy: two levels and the pooling between them."""

    fine: OneRings
    pooling: Pooling
    coarse: OneRings


class RingSamples(NamedTuple):
    """Colours at points drawn uniformly by area in each one-ring: what the encoder sees."""

    logs: Complex64[Any, "*B S"]  # log_p of each sample
    colors: Float32[Any, "*B S 3"]


class SurfacePoints(NamedTuple):
    """Points on a triangle mesh."""

    faces: Int[Any, "P"]
    barycentrics: Float64[Any, "P 3"]


class Queries(NamedTuple):
    """The input of the decoder: each point seen from the three corners of its face."""

    vertices: Int32[Any, "P 3"]
    logs: Complex64[Any, "P 3"]
    barycentrics: Float32[Any, "P 3"]
