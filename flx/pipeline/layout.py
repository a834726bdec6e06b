"""Layouts for a trained network: patchworks of its input, as codes.

Few steps teach a network how details look, not where large motifs go. A patchwork has whole motifs, and seams
between them. Noised by a part of the schedule and denoised by the network, it keeps the motifs; the network
closes the seams and draws details anew. Where it drew what was there, the texels of the input return: the
codec blurs them.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Complex64, Float32

from flx.assets.asset import Asset, Images
from flx.controls import Controls, Patches
from flx.geometry.copies import points_in_rings, queries_at
from flx.geometry.direction import carried, field_on
from flx.geometry.labels import LabelMap, labels_on
from flx.geometry.patchwork.anchors import Anchors
from flx.geometry.patchwork.guides import Guides
from flx.geometry.tangent import tangent_frames
from flx.pipeline.canvas import Canvas
from flx.pipeline.codec import Codec
from flx.pipeline.direction import read_direction
from flx.pipeline.generator import Generator
from flx.pipeline.instant import (
    PatchGenerator,
    color_shifts,
    colors_from,
    open_canvases,
    painted,
    patches_on,
)
from flx.pipeline.labels import read_labels
from flx.pipeline.masks import kept_texels
from flx.types import SLOTS, Queries, RingSamples, Slot, Triangulation

ALIKE = 0.15  # difference of colours by which the network's result is another one than the layout's


class Layout(NamedTuple):
    """One patchwork: where its texels are, and its codes."""

    anchors: Anchors
    shifts: Float32[Any, "V 3"]  # of colours, see `color_shifts`
    codes: Complex64[Any, "V D"]


@dataclass(frozen=True)
class Layouts:
    """Patchworks on the triangulation that codes are made on."""

    codec: Codec
    patches: PatchGenerator
    logs: Complex64[Any, "V S"]  # where each one-ring is looked at
    queries: Queries

    def every(self, seeds: Sequence[list[int]], workers: int | None = 1) -> Iterator[Layout]:
        """A layout for each seed, the same bits on the same machine; see `PatchGenerator.every`."""
        return map(self.of, self.patches.every(seeds, workers))

    def of(self, anchors: Anchors) -> Layout:
        """The patchwork of some anchors."""
        shifts = color_shifts(self.patches.synthesis, anchors)
        colors = colors_from(self.patches, anchors, "base_color", shifts)(self.queries)
        rings = RingSamples(self.logs, colors.reshape(*self.logs.shape, 3))
        return Layout(anchors, shifts, self.codec.encode(rings))

    def other_canvases(self, texture_size: int | None) -> list[Canvas]:
        """Those of all maps but the base colours, which the network makes."""
        return open_canvases(self.patches, texture_size, [slot for slot in SLOTS if slot != "base_color"])

    def other_maps(self, canvases: Sequence[Canvas], layout: Layout) -> Mapping[Slot, Images]:
        """Other maps than the base colours, from where those begin."""
        return painted(self.patches, canvases, layout.anchors).maps if canvases else {}

    def finished(
        self, layout: Layout, codes: Complex64[Any, "V D"]
    ) -> Callable[[Queries], Float32[Any, "P 3"]]:
        """A painter: the colours of codes, and what the codec lost of the layout where they are alike."""
        new, old = self.codec.decoder(codes), self.codec.decoder(layout.codes)
        texels = colors_from(self.patches, layout.anchors, "base_color", layout.shifts)

        def colors(queries: Queries) -> Float32[Any, "P 3"]:
            shown, before = np.asarray(new(queries)), np.asarray(old(queries))
            same = np.exp(-np.square(shown - before).sum(1, keepdims=True) / ALIKE**2)
            return np.clip(shown + same * (texels(queries) - before), 0, 1)

        return colors


def layouts(generator: Generator, triangulation: Triangulation, asset: Asset, controls: Controls) -> Layouts:
    """Patchworks of the texture that a generator learnt, on a triangulation of an asset, as controls say."""
    vertices = len(generator.home.triangulation.vertices)
    guides, kept = learnt_guides(generator, asset, controls), kept_texels(generator.asset, controls)
    source = asset if asset.digest == generator.asset.digest else generator.asset  # it may have more maps
    rules = Patches(), controls, guides, kept, generator.intact
    own = patches_on(triangulation, vertices, source, asset, *rules)
    points, logs = points_in_rings(triangulation, generator.codec.config.samples, np.random.default_rng(0))
    return Layouts(
        generator.codec, own, logs, queries_at(points, triangulation, tangent_frames(triangulation))
    )


def asked_labels(
    learnt: LabelMap | None, asset: Asset, patches: Patches, drawn: Path | None
) -> tuple[LabelMap, LabelMap] | None:
    """The labels of an asset, and those that are asked for, in one palette; None where there are none.

    Those that were learnt, unless `patches` say what the input is like.
    """
    file = patches.input_labels or (drawn if learnt is None else None)
    before = read_labels(file, asset) if file else learnt
    if before is None:
        return None
    return before, read_labels(drawn, asset, before.palette) if drawn else before


def run_guides(
    generator: Generator, asset: Asset, patches: Patches, controls: Controls
) -> tuple[Guides, Guides] | None:
    """`learnt_guides`; None where none were learnt, or `patches` say what the input is like."""
    learnt = generator.labels is not None or generator.direction is not None
    if not learnt or patches.input_labels or patches.input_direction:
        return None
    return learnt_guides(generator, asset, controls)


def learnt_guides(generator: Generator, asset: Asset, controls: Controls) -> tuple[Guides, Guides]:
    """The labels and the direction that a generator learnt, and those that controls give an asset.

    None that the asset has not, and none at guidance 0.
    """
    own, other, same = Guides(), Guides(), asset.digest == generator.asset.digest
    if controls.guidance and (before := generator.labelled) and (controls.labels or same):
        after = read_labels(controls.labels, asset, before.palette) if controls.labels else before
        own, other = Guides(partial(labels_on, before)), Guides(partial(labels_on, after))
    if controls.guidance and generator.direction is not None and (controls.direction or same):
        own = own._replace(direction=partial(carried, generator.direction, generator.home.triangulation))
        given = controls.direction and read_direction(controls.direction, asset)
        other = other._replace(direction=partial(field_on, given) if given else own.direction)
    return own, other.turned(controls.rotate)
