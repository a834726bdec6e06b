"""New textures without training: patchworks of an asset's own texture (`flx.geometry.patchwork`).

Texels are looked up in the original images, so that nothing is lost to a codec and all maps of a material
stay in register. Colours are shifted smoothly where pieces meet: slow changes of brightness do not end at a
seam. The seams themselves are a fraction of an edge wide.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.linalg import splu

from flx.arguments import check_kind, whole
from flx.assets.asset import Asset, Images, Painting, check_asset
from flx.assets.shape import read_shape
from flx.controls import Controls, Patches
from flx.geometry.arrays import face_areas, mark, unit_vectors
from flx.geometry.atlas import with_filled_gutters
from flx.geometry.color import eight_bits, resized
from flx.geometry.copies import check_memory
from flx.geometry.direction import field_on
from flx.geometry.labels import labels_on
from flx.geometry.patchwork.anchors import Anchors, settled
from flx.geometry.patchwork.borders import belonging, corner_weights
from flx.geometry.patchwork.guides import Guides, Weights
from flx.geometry.patchwork.synthesis import FINER, Pieces, Synthesis, patchwork, pieces, prepare, synthesize
from flx.geometry.remesh.remesh import remesh
from flx.geometry.sampling import face_normals, surface_colors, transfer
from flx.pipeline.canvas import Canvas, bake, check_size, open_canvas
from flx.pipeline.direction import file_of, read_direction
from flx.pipeline.inpainting import HELD, Inpainting, kept_shares, restored
from flx.pipeline.labels import read_labels
from flx.pipeline.masks import Kept, kept_texels, marked
from flx.pipeline.transfer import scaled_count
from flx.pipeline.workers import in_order, in_processes, workers_for
from flx.types import SLOTS, Queries, Slot, SurfacePoints, TexturedMesh, Triangulation

SAMPLES = 64  # points of a one-ring that say whether it is kept
LEAST = 0.03  # share of a blend below which a corner is left out
SAME = 0.02  # difference of colours up to which two neighbours count as one piece
BRIGHTNESS = 0.12  # difference that may be one of brightness; much larger ones are edges of the pattern
STAY = 0.003  # weight of not shifting colours at all
WORKER_BYTES, VERTEX_BYTES = 5e8, 12_000  # of a process that makes patchworks, and per vertex of its source
FIXED = 1e3  # the same at a vertex whose texture is kept


@dataclass(frozen=True)
class PatchGenerator:
    """What makes patchworks of one asset's texture, on it or on another mesh."""

    asset: Asset  # whose texture it is
    target: Asset  # what is painted
    mesh: TexturedMesh  # the source, with filled gutters
    synthesis: Synthesis
    patches: Patches
    held: Inpainting | None  # what stays of the texture
    weights: Weights  # of what its pieces share with the places that they come to

    def sample(self, seed: int | list[int]) -> Anchors:
        """Where every vertex of the finest target comes from. Same seed, same machine: same bits."""
        return synthesize(self.synthesis, seed, self.patches.coherence, self.weights)

    def every(self, seeds: Sequence[list[int]], workers: int | None = 1) -> Iterator[Anchors]:
        """`sample` of many seeds in processes, in their order; None: as many as this machine has room for."""
        room = WORKER_BYTES + VERTEX_BYTES * FINER * len(self.triangulation.vertices)
        workers = min(workers or workers_for(room), len(seeds))
        if workers < 2:
            yield from map(self.sample, seeds)
        else:
            one = partial(synthesize, coherence=self.patches.coherence, weights=self.weights)
            yield from in_order(in_processes(one, (self.synthesis,), [(seed,) for seed in seeds], workers))

    def pieces(self, anchors: Anchors) -> Pieces:
        """How many pieces of the input a result has, how large they are, and how much did not move at all."""
        return pieces(self.synthesis, anchors)

    @property
    def triangulation(self) -> Triangulation:
        """The finest target."""
        return self.synthesis.levels[-1].target.triangulation


def patch_generator(
    asset: Asset,
    patches: Patches | None = None,
    seed: int = 0,
    controls: Controls | None = None,
    target: Asset | None = None,
    guides: tuple[Guides, Guides] | None = None,
    intact: Kept | None = None,
) -> PatchGenerator:
    """Prepare new textures from pieces of an asset's own; no training.

    Args:
        asset: The mesh whose texture it is, from `flx.load`. Other maps that were read with it change, too.
        patches: How pieces are chosen, a `flx.Patches`.
        seed: Of the triangulations.
        controls: A `flx.Controls`; all but strength can be followed.
        target: The mesh to paint, from `flx.load_shape`; that of the controls, or the asset, unless given.
        guides: How to find labels and directions of the asset and of the target; in the files that the
            controls and `patches` name, unless given.
        intact: What pieces may come from; all but what the controls fill, unless given.

    Raises ValueError for controls that cannot be followed, and for a mesh that cannot be triangulated.

    Example:
        generator = flx.patch_generator(flx.load("bowl.glb"))
        for n, painting in enumerate(flx.patchworks(generator, count=4)):
            flx.save(generator.target, painting, f"variation_{n}.glb")
    """
    check_asset("asset", asset)
    patches = Patches() if patches is None else patches
    controls = Controls() if controls is None else controls
    check_kind("patches", patches, Patches, "a flx.Patches")
    check_kind("controls", controls, Controls, "a flx.Controls")
    seed = whole("seed", seed)
    check_instant(patches, controls, guides)
    if target is None:
        target = read_shape(controls.mesh) if controls.mesh else asset
    check_asset("target", target)
    kept = kept_texels(asset, controls)
    guides = guides_of(asset, target, patches, controls) if guides is None else guides
    if kept and target.digest != asset.digest:
        raise ValueError(f"a mask is one of {asset.path}; leave keep and fill out for another mesh")
    count = scaled_count(patches.vertices, asset, target, controls.scale)
    check_memory(FINER * max(count, patches.vertices))
    try:
        triangulation = remesh(target.mesh.vertices, target.mesh.faces, count, seed)
    except ValueError as fault:
        raise ValueError(f"{target.path}: {fault} (--vertices)") from None
    rules = patches, controls, guides, kept, intact, seed
    return patches_on(triangulation, patches.vertices, asset, target, *rules)


def patches_on(
    triangulation: Triangulation,
    vertices: int,
    asset: Asset,
    target: Asset,
    patches: Patches,
    controls: Controls,
    guides: tuple[Guides, Guides],
    kept: Kept | None,
    intact: Kept | None = None,
    seed: int = 0,
) -> PatchGenerator:
    """A `patch_generator` on a triangulation of the target; one of the asset would have so many vertices."""
    mesh, count = with_filled_gutters(asset.mesh), len(triangulation.vertices)
    surface, same = Triangulation(target.mesh.vertices, target.mesh.faces), target.digest == asset.digest
    held, free, left = None, None, [intact] if intact else []
    if kept:
        shares = kept_shares(mesh, kept, triangulation, SAMPLES)
        held, free = Inpainting(kept, shares, None), shares < HELD
        if controls.fill:
            faces = triangulation.faces
            free = mark(count, faces[(shares < 1)[faces].any(1)])  # no damage is held, however small
            left.append(kept)
    damaged = marked(mesh, *left) if left else None
    # How much larger than in the input details are in the units of the files, which may not be the same.
    size = np.sqrt(face_areas(*surface).sum() / face_areas(mesh.vertices, mesh.faces).sum())
    scale = float(size * np.sqrt(vertices / count))
    own, other = (each._replace(height=controls.height) for each in guides)
    synthesis = prepare(mesh, triangulation, seed, scale, surface, free, damaged, same, (own, other))
    weights = Weights(patches.guide, controls.guidance)
    return PatchGenerator(asset, target, mesh, synthesis, patches, held, weights)


def check_instant(patches: Patches, controls: Controls, guides: tuple[Guides, Guides] | None = None) -> None:
    """Raises ValueError for controls that cannot be followed without training.

    `guides` are those of a run that learnt some.
    """
    for name in ("strength", "invention"):
        if (value := getattr(controls, name)) != getattr(Controls(), name):
            said = f"{name} is {value}, but nothing is learnt here"
            raise ValueError(f"{said}; train a run, or leave it out")
    directed = controls.direction or (guides and guides[1].direction)
    guided = guides is not None or controls.labels or patches.input_labels or directed or controls.height
    if controls.guidance != 1 and not guided:
        said = f"guidance is {controls.guidance}, but there is nothing to follow"
        raise ValueError(f"{said}; give labels, a direction or a height, or leave it out")
    if not directed and (controls.rotate or patches.input_direction):
        name, value = "rotate", controls.rotate
        if patches.input_direction:
            name, value = "input direction", patches.input_direction
        raise ValueError(f"{name} is {value}, but there is no direction; give it with --direction")


def guides_of(asset: Asset, target: Asset, patches: Patches, controls: Controls) -> tuple[Guides, Guides]:
    """Labels and directions of the input and of the target.

    Those of one also hold for the other unless given; labels do so where both are the same mesh, strokes too.
    Raises ValueError as `read_labels` and `read_direction` do, and for what the other mesh cannot have.
    """
    same, own, other = target.digest == asset.digest, Guides(), Guides()
    drawn, learnt = controls.labels, patches.input_labels
    if drawn and not (learnt or same):
        raise ValueError(f"labels {drawn} are those of {target.path}; give the input's with --input-labels")
    if learnt and not (drawn or same):
        raise ValueError(f"input labels {learnt}: {target.path} has none yet; give them with --labels")
    if before := learnt or drawn:
        here = read_labels(before, asset)
        there = read_labels(drawn or before, target, here.palette)
        own, other = Guides(partial(labels_on, here)), Guides(partial(labels_on, there))
    if controls.direction:
        before = patches.input_direction or controls.direction
        if not (same or patches.input_direction) and file_of(before):
            raise ValueError(
                f"direction {before} is drawn on {target.path}; say which way the input runs with "
                "--input-direction"
            )
        here, there = read_direction(before, asset), read_direction(controls.direction, target)
        own = own._replace(direction=partial(field_on, here))
        other = other._replace(direction=partial(field_on, there))
    return own, other.turned(controls.rotate)


def patchworks(
    generator: PatchGenerator,
    count: int = 4,
    seed: int = 0,
    texture_size: int | None = None,
    workers: int | None = 1,
) -> Iterator[Painting]:
    """New textures, one after another, in every map that was read.

    Args:
        generator: From `flx.patch_generator`.
        count: How many.
        seed: Variation n depends on the seed and n alone.
        texture_size: Pixels on the longer side; the input's, at most 2048 (all where some are kept), unless
            given.
        workers: Processes that make them; None: as many as this machine has room for. A script that asks for
            several must keep its own work under `if __name__ == "__main__":`.

    Example:
        painting = next(flx.patchworks(flx.patch_generator(asset)))
    """
    check_kind("generator", generator, PatchGenerator, "what flx.patch_generator returns")
    count, seed = whole("count", count, 1), whole("seed", seed)
    check_size(texture_size, "texture_size")
    canvases = open_canvases(generator, texture_size)
    for anchors in generator.every([[seed, n] for n in range(count)], workers):
        yield painted(generator, canvases, anchors)


def open_canvases(
    generator: PatchGenerator, texture_size: int | None = None, slots: Sequence[Slot] = SLOTS
) -> list[Canvas]:
    """One for each of these maps that both the target and the source have."""
    if generator.held:
        texture_size = texture_size or max(generator.held.kept.texels.shape)
    both = generator.target.mesh.maps.keys() & generator.mesh.maps.keys()
    return [
        open_canvas(generator.target, generator.triangulation, texture_size, slot)
        for slot in slots
        if slot in both
    ]


def painted(generator: PatchGenerator, canvases: Sequence[Canvas], anchors: Anchors) -> Painting:
    """The maps of the target as its anchors find them in the source."""
    shifts = np.zeros((len(generator.triangulation.vertices), 3), np.float32)
    if any(canvas.slot == "base_color" for canvas in canvases):
        shifts = color_shifts(generator.synthesis, anchors)
    maps: dict[Slot, Images] = {}
    colors = Painting({}).colors
    for canvas in canvases:
        if canvas.slot == "normal":
            onto = partial(_as_texels, *tangent_axes(generator.target.mesh))
            made = bake(canvas, normals_from(generator, anchors), onto)
        else:
            added = shifts if canvas.slot == "base_color" else np.zeros_like(shifts)
            made = bake(canvas, colors_from(generator, anchors, canvas.slot, added))
        if generator.held:
            made = (restored if canvas.slot == "base_color" else _put_back)(generator.held, canvas, made)
        maps.update(made.maps)
        colors = made.colors if len(made.colors) else colors
    return Painting(maps, colors)


def _put_back(held: Inpainting, canvas: Canvas, painting: Painting) -> Painting:
    """Another map with what is kept of it, where it has the texture coordinates of the base colours."""
    mesh, slot = canvas.asset.mesh, canvas.slot
    own, base = mesh.maps[slot], mesh.maps["base_color"]
    if not np.array_equal(own.corner_uvs, base.corner_uvs):
        return painting
    images = list(painting.maps[slot])
    for index in np.unique(own.face_images[base.face_images == held.kept.index]):
        height, width = images[index].shape[:2]
        texels = held.kept.at_size(height, width).texels[..., None]
        before = resized(eight_bits(own.images[index]), height, width)
        images[index] = np.where(texels, before, eight_bits(images[index]))
    return painting._replace(maps={**painting.maps, slot: tuple(images)})


def colors_from(
    generator: PatchGenerator, anchors: Anchors, slot: Slot, added: Float32[Any, "V 3"]
) -> Callable[[Queries], Float32[Any, "P 3"]]:
    """A painter: what a map of the source has where the anchors lead, and what is added at each vertex."""

    def colors(at: Int[Any, "n"], _: Anchors, points: SurfacePoints) -> Float32[Any, "n 3"]:
        return np.clip(surface_colors(generator.mesh, points, slot) + added[at], 0, 1)

    return _painter(generator, anchors, colors)


def normals_from(generator: PatchGenerator, anchors: Anchors) -> Callable[[Queries], Float32[Any, "P 3"]]:
    """A painter: how far normals lean in the source's normal map, turned to the target, in its space."""
    level, mesh = generator.synthesis.levels[-1], generator.mesh
    source, target = level.source.surface, level.target
    right, up = tangent_axes(mesh)

    def leaning(at: Int[Any, "n"], there: Anchors, points: SurfacePoints) -> Float32[Any, "n 3"]:
        mapped = 2 * surface_colors(mesh, points, "normal") - 1
        lean = mapped[:, :1] * right[points.faces] + mapped[:, 1:2] * up[points.faces]
        x, y = source.x_axes[there.vertices], source.y_axes[there.vertices]
        turned = ((lean * x).sum(1) + 1j * (lean * y).sum(1)) * np.conj(there.turns)
        vector = target.x_axes[at] * turned.real[:, None] + target.y_axes[at] * turned.imag[:, None]
        return vector.astype(np.float32)

    return _painter(generator, anchors, leaning)


def _painter(
    generator: PatchGenerator,
    anchors: Anchors,
    values: Callable[[Int[Any, "n"], Anchors, SurfacePoints], Float32[Any, "n 3"]],
) -> Callable[[Queries], Float32[Any, "P 3"]]:
    """What gives values where the three corners of each point's face lead, sharply blended."""
    level = generator.synthesis.levels[-1]
    source, of = level.source.surface, belonging(patchwork(generator.synthesis, anchors))

    def blended(queries: Queries) -> Float32[Any, "P 3"]:
        weights = corner_weights(of, queries)
        weights[weights < LEAST] = 0
        weights /= weights.sum(1, keepdims=True)
        blend = np.zeros((len(weights), 3), np.float32)
        for corner in range(3):
            rows = np.flatnonzero(weights[:, corner])
            at = queries.vertices[rows, corner]
            there = settled(source, anchors.at(at).moved(queries.logs[rows, corner], level.step))
            points = source.points_at(there.vertices, there.offsets)
            points = transfer(points, source.triangulation, generator.mesh)
            blend[rows] += weights[rows, corner, None] * values(at, there, points)
        return blend

    return blended


def tangent_axes(mesh: TexturedMesh) -> tuple[Float32[Any, "F 3"], Float32[Any, "F 3"]]:
    """What the red and the green of each face's normal map mean in space: right and up on the texture.

    Unit vectors at right angles, as in glTF; 0 where a face has no area on the texture.
    """
    corners, uvs = mesh.vertices[mesh.faces], mesh.maps["normal"].corner_uvs
    sides, steps = corners[:, 1:] - corners[:, :1], uvs[:, 1:] - uvs[:, :1]
    side = np.sign(steps[:, 0, 0] * steps[:, 1, 1] - steps[:, 0, 1] * steps[:, 1, 0])[:, None]
    right = unit_vectors(side * (sides[:, 0] * steps[:, 1, 1:] - sides[:, 1] * steps[:, 0, 1:]))
    up = -side * np.cross(face_normals(mesh.vertices, mesh.faces), right)
    return right.astype(np.float32), up.astype(np.float32)


def _as_texels(
    right: Float32[Any, "F 3"], up: Float32[Any, "F 3"], faces: Int[Any, "n"], leaning: Float32[Any, "n 3"]
) -> Float32[Any, "n 3"]:
    """Vectors in space as texels of a normal map."""
    x, y = (leaning * right[faces]).sum(1), (leaning * up[faces]).sum(1)
    longer = np.maximum(np.hypot(x, y), 1)
    x, y = x / longer, y / longer
    return np.stack([x, y, np.sqrt(np.maximum(1 - x * x - y * y, 0))], 1) / 2 + 0.5


def color_shifts(synthesis: Synthesis, anchors: Anchors) -> Float32[Any, "V 3"]:
    """Shifts of colour at the vertices, by which pieces of different brightness meet without a step.

    Least squares, as in Poisson image editing (Pérez et al. 2003): neighbours of one piece are shifted alike;
    across a seam the shifts differ by what colours differ there, unless that is an edge of the pattern.
    """
    work = patchwork(synthesis, anchors)
    here, there = work.shown[work.p, work.slot], work.shown[work.q, work.back, ::-1]
    missing = (there - here)[..., :3].mean(1)  # what the neighbour says more than p
    size = np.abs(missing).max(1)
    same = size < SAME
    roots = np.sqrt(np.where(same, 1, np.exp(-((size / BRIGHTNESS) ** 2))))
    wanted = np.where(same[:, None], 0, missing) * roots[:, None]
    edges, count = np.arange(len(work.p)), len(work.target)
    places = np.concatenate([edges, edges]), np.concatenate([work.p, work.q])
    differences = csr_array((np.concatenate([roots, -roots]), places), shape=(len(edges), count))
    stay = np.where(synthesis.free, STAY, FIXED)  # what is kept has the colours that it had
    system = csc_array(differences.T @ differences + diags_array(stay))
    shifts: Float64[Any, "V 3"] = splu(system).solve(differences.T @ wanted)
    return shifts.astype(np.float32)
