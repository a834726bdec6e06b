"""New textures from a generator, as controls ask for them, and its own texture through the codec."""

import sys
from collections.abc import Iterator
from itertools import repeat
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Complex64, Complex128, Int32
from tqdm import tqdm

from flx.arguments import check_kind, whole
from flx.assets.asset import Asset, Painting
from flx.assets.shape import read_shape
from flx.config import STEPS, Sampler
from flx.controls import Controls
from flx.fields.samplers import Hook
from flx.geometry.atlas import with_filled_gutters
from flx.geometry.copies import sample_rings
from flx.geometry.direction import Direction, carried, field_on
from flx.geometry.labels import LabelMap, labels_on
from flx.geometry.remesh.remesh import remesh
from flx.pipeline.canvas import bake, check_size, open_canvas
from flx.pipeline.direction import read_direction
from flx.pipeline.generator import Generator, Home
from flx.pipeline.inpainting import REPEATS, Inpainting, inpainting, restored
from flx.pipeline.labels import read_labels
from flx.pipeline.layout import Layouts, layouts
from flx.pipeline.masks import kept_texels, without_damage
from flx.pipeline.transfer import home_on
from flx.types import Triangulation


class Controlled(NamedTuple):
    """Controls, as sampling follows them on one triangulation."""

    home: Home  # what codes are made on
    hook: Hook | None
    near: Complex64[np.ndarray, "V D"] | None  # codes to stay near
    kept: Inpainting | None  # what stays of the texture
    labels: Int32[np.ndarray, "V"] | None  # what goes where
    direction: Complex128[np.ndarray, "V"] | None  # which way the texture runs
    layouts: Layouts | None  # what the network begins with


def controlled(generator: Generator, controls: Controls, asset: Asset) -> Controlled:
    """What a generator needs to follow some controls on its own asset or on another.

    Raises ValueError for controls that it cannot follow.
    """
    check_controls(generator, controls, asset)
    home = home_on(generator, asset, controls.scale)
    near = own_codes(generator, home.triangulation) if controls.strength < 1 else None
    kept = kept_texels(generator.asset, controls)
    held = kept and inpainting(generator, kept, home.triangulation)
    labels = labels_for(generator, controls, asset, home.triangulation)
    direction = direction_for(generator, controls, asset, home.triangulation)
    begun = layouts(generator, home.triangulation, asset, controls) if controls.invented < 1 else None
    return Controlled(home, held and held.hook, near, held, labels, direction, begun)


def check_controls(generator: Generator, controls: Controls, asset: Asset) -> None:
    """Raises ValueError for controls that a generator cannot follow on an asset, before anything is made."""
    if asset.digest != generator.asset.digest and (controls.strength < 1 or controls.keep or controls.fill):
        raise ValueError(f"{asset.path} has no texture to stay near; leave strength, keep and fill out")
    check_labels(generator, controls, asset)
    check_direction(generator, controls, asset)


def check_labels(generator: Generator, controls: Controls, asset: Asset) -> LabelMap | None:
    """The labels of the controls. Raises ValueError for such, or a weight, that a generator cannot follow."""
    said = f"labels {controls.labels}" if controls.labels else f"guidance {controls.guidance:g}"
    weighed = controls.guidance != 1 and generator.direction is None
    if generator.labels is None and (controls.labels or weighed):
        raise ValueError(f"{said}: this run learnt no labels; train one with --surface.labels IMAGE")
    if controls.labels:
        assert generator.labels
        return read_labels(controls.labels, asset, generator.labels.palette)
    given = controls.direction is not None
    if asset.digest != generator.asset.digest and controls.guidance not in (0, 1) and not given:
        what = "labels to follow; give an image on its UVs with --labels"
        if generator.labels is None:
            what = "direction to follow; give one with --direction"
        raise ValueError(f"{said}: {asset.path} has no {what}")
    return None


def check_direction(generator: Generator, controls: Controls, asset: Asset) -> Direction | None:
    """The direction of the controls. Raises ValueError for one that a generator cannot follow."""
    given = controls.direction
    said = f"rotate {controls.rotate:g}" if given is None else f"direction {given}"
    if generator.direction is None and (given is not None or controls.rotate):
        raise ValueError(f"{said}: this run learnt no direction; train one with --surface.direction FIELD")
    if given is not None:
        return read_direction(given, asset)
    if asset.digest != generator.asset.digest and controls.rotate:
        raise ValueError(f"{said}: {asset.path} has no direction to turn; give one with --direction")
    return None


def direction_for(
    generator: Generator, controls: Controls, asset: Asset, triangulation: Triangulation
) -> Complex128[np.ndarray, "V"] | None:
    """The direction at the vertices of a triangulation of an asset: that of the controls, or the learnt one,
    turned as they say.

    None where there is none, as on another mesh, which stderr then says. Raises as `check_direction` does.
    """
    given = check_direction(generator, controls, asset)
    if generator.direction is None or controls.guidance == 0:
        return None
    home = generator.home.triangulation
    if given is not None:
        found = field_on(given, triangulation)
    elif asset.digest != generator.asset.digest:
        note = "no direction is given for it, so details turn any way; --direction FIELD says which"
        tqdm.write(f"{asset.path.name}: {note}", file=sys.stderr)
        return None
    elif triangulation is home:
        found = generator.direction
    else:
        found = carried(generator.direction, home, triangulation)
    return found * np.exp(1j * np.deg2rad(controls.rotate))


def labels_for(
    generator: Generator, controls: Controls, asset: Asset, triangulation: Triangulation
) -> Int32[np.ndarray, "V"] | None:
    """The labels of the vertices of a triangulation of an asset: those of the controls, or the learnt ones.

    None where there are none, as on another mesh, which stderr then says. Raises as `check_labels` does.
    """
    given = check_labels(generator, controls, asset)
    if generator.labels is None or controls.guidance == 0:
        return None
    if given:
        return labels_on(given, triangulation)
    if asset.digest != generator.asset.digest:
        note = "no labels are given for it, so details go anywhere; --labels IMAGE on its UVs says where"
        tqdm.write(f"{asset.path.name}: {note}", file=sys.stderr)
        return None
    if triangulation is generator.home.triangulation or generator.labelled is None:
        return generator.labels.numbers
    return labels_on(generator.labelled, triangulation)


def generate(
    generator: Generator,
    count: int = 4,
    seed: int = 0,
    steps: int = STEPS,
    sampler: Sampler = "dpm",
    texture_size: int | None = None,
    asset: Asset | None = None,
    controls: Controls | None = None,
    workers: int | None = 1,
) -> Iterator[Painting]:
    """New textures of the asset that the generator learnt from, one after another.

    Args:
        generator: From `flx.load_generator`.
        count: How many.
        seed: Variation n depends on the seed and n alone.
        steps, sampler: See `Generator.sample`.
        texture_size: Pixels on the longer side; the input's, at most 2048 (all where some are kept), unless
            given.
        asset: Another mesh to paint, from `flx.load_shape`; or the generator's own with an atlas, if it
            came without one, or with other maps (`generator.asset_with_maps`), which then follow in register.
        controls: What guides them, a `flx.Controls`.
        workers: Processes that look for pieces of the input; None: as many as this machine has room for. A
            script that asks for several must keep its own work under `if __name__ == "__main__":`.

    Raises ValueError for controls that the generator cannot follow.

    Example:
        for n, painting in enumerate(flx.generate(generator, count=4)):
            flx.save(generator.asset, painting, f"variation_{n}.glb")
    """
    check_kind("generator", generator, Generator, "what flx.load_generator returns")
    count, steps, seed = whole("count", count, 1), whole("steps", steps, 1), whole("seed", seed)
    check_size(texture_size, "texture_size")
    check_kind("controls", controls or Controls(), Controls, "a flx.Controls")
    controls = controls or Controls()
    if asset is None:
        asset = read_shape(controls.mesh) if controls.mesh else generator.asset
    home, hook, near, held, labels, direction, begun = controlled(generator, controls, asset)
    if held:
        texture_size = texture_size or max(held.kept.texels.shape)
    canvas = open_canvas(asset, home.triangulation, texture_size)
    repeats = REPEATS if held else None
    others = begun.other_canvases(texture_size) if begun else []
    share = min(controls.strength, controls.invented)

    def paintings() -> Iterator[Painting]:
        starts = begun.every([[seed, n] for n in range(count)], workers) if begun else repeat(None, count)
        for n, start in enumerate(starts):
            key = jax.random.fold_in(jax.random.key(seed), n)
            rules = (steps, sampler, hook, start.codes if start else near, share, repeats)
            codes = generator.sample(key, home, *rules, labels, controls.guidance, direction)
            painter = begun.finished(start, codes) if begun and start else generator.codec.decoder(codes)
            painting = bake(canvas, painter)
            painting = restored(held, canvas, painting) if held else painting
            if begun and start:
                painting = painting._replace(maps={**painting.maps, **begun.other_maps(others, start)})
            yield painting

    return paintings()  # what cannot be followed is refused at the call, not at the first texture


def reconstruct(generator: Generator, texture_size: int | None = None) -> Painting:
    """The asset's own texture through the codec, on a triangulation that training did not see.

    It is what samples could reach at best.
    """
    surface = generator.experiment.surface
    mesh, unseen = with_filled_gutters(generator.asset.mesh), surface.seed + surface.copies
    triangulation = remesh(mesh.vertices, mesh.faces, len(generator.home.triangulation.vertices), unseen)
    canvas = open_canvas(generator.asset, triangulation, texture_size)
    return bake(canvas, generator.codec.decoder(own_codes(generator, triangulation, unseen)))


def own_codes(
    generator: Generator, triangulation: Triangulation, seed: int = 0
) -> Complex64[np.ndarray, "V D"]:
    """The codes of the texture that the generator learnt from, at the vertices of a triangulation of it."""
    asset, codec = without_damage(generator.asset, generator.intact), generator.codec
    mesh = with_filled_gutters(asset.mesh)
    return codec.encode(sample_rings(mesh, triangulation, codec.config.samples, seed))
