"""`flx doctor`: what is in a mesh file, what a planned run meets on it, and a verdict.

A mesh that cannot be used never comes here: `read_asset` refuses it, and that line is the verdict.

The costs are estimates, within a factor of two on two CPU cores like those they were measured on (AMD EPYC
without AMX; `experiments/demo.py` at 5,000 vertices, `experiments/bowl.py` at 10,000, and `flx bench`).
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool
from tyro.conf import Positional

from flx.assets.asset import Asset, Report
from flx.assets.inspect import coverage, inside_out_components, ring_pixels
from flx.assets.read import read_asset
from flx.config import FLDM, FLDMExperiment, Train, read_config
from flx.geometry.atlas import uv_areas
from flx.models.denoiser.depth import blocks_for

RING_PIXELS = (7.0, 450.0)  # in one-rings that the FL-VAE was trained on: 1.5 to 12 pixels from the vertex
COPY_SECONDS = 1.6e-4  # for each vertex of a copy: remeshing, tables, colours, two copies at once
COPY_BYTES = 600  # on disk, for each vertex of a copy: tables and latents
# For each vertex, channel, block and copy of a training step, by network.
STEP_SECONDS = {"vectors": 5.0e-7, "mixed": 2.7e-7}
STEP_BYTES = 900  # for each of the same
BASE_BYTES = 600e6  # JAX, and the mesh


@dataclass(frozen=True)
class Doctor:
    """Say what is in a mesh file, what would be repaired and what a run would take. Writes nothing.

    Example: flx doctor bowl.glb --config experiments/bowl.py
    """

    mesh: Positional[Path]  # a .glb, .gltf, .obj or .ply file
    texture: Path | None = None  # an image to use instead of the file's own
    config: Path | None = None  # the run that is planned, as for `flx train`; the paper's unless given
    vertices: int | None = None  # of the planned run; the config's unless given
    json: bool = False  # print one JSON object

    def __call__(self) -> None:
        plan = FLDMExperiment() if self.config is None else read_config(self.config)
        if not isinstance(plan, FLDMExperiment):
            raise ValueError(f"{self.config} trains no mesh; give a config such as experiments/demo.py")
        if self.vertices is not None:
            plan = replace(plan, surface=replace(plan.surface, vertices=self.vertices))
        try:
            asset = read_asset(self.mesh, self.texture)
        except (ValueError, OSError) as refusal:
            if self.json:
                print(json.dumps({"path": str(self.mesh), "verdict": f"refused: {refusal}"}, indent=2))
            raise
        findings = examine(asset, plan)
        record = {**asset.report._asdict(), **findings._asdict(), "plan": findings.plan._asdict()}
        print(json.dumps(record, indent=2) if self.json else describe(asset.report, findings))


class Plan(NamedTuple):
    """A training run: how large, and what it will take."""

    papers: bool  # the paper's own model and training
    vertices: int
    copies: int
    steps: int
    batch: int
    ring_pixels: tuple[float, float, float] | None  # in a one-ring: 5th percentile, median and 95th by area
    copy_seconds: float  # of all copies, on two cores like all that follows
    disk_bytes: float
    step_seconds: float
    train_seconds: float
    train_bytes: float


class Findings(NamedTuple):
    """What is right or wrong with a mesh that can be used. Plain numbers and words, for JSON."""

    inside_out_components: int  # closed, and their faces look inwards
    mirrored_uv_faces: int  # seen from behind on their texture; both ways is common, and harmless
    covered_texels: float  # share of the textures that the surface shows
    overlapping_texels: float  # share of these that it shows more than once
    plan: Plan
    warnings: tuple[str, ...]
    verdict: str


def examine(asset: Asset, experiment: FLDMExperiment) -> Findings:
    """What reading the asset did not need to know, for a run of `experiment` on it."""
    covered, overlapping = coverage(asset)
    flat = np.array([texture.flat for texture in asset.textures] or [True])[asset.mesh.face_textures]
    plan = _plan(asset, ~flat, experiment)
    inside_out = inside_out_components(asset)
    warnings = _warnings(asset.report, plan, overlapping, inside_out)
    return Findings(
        inside_out_components=inside_out,
        mirrored_uv_faces=int(((uv_areas(asset.mesh) < 0) & ~flat).sum()),
        covered_texels=covered,
        overlapping_texels=overlapping,
        plan=plan,
        warnings=warnings,
        verdict=_verdict(asset.report, len(warnings)),
    )


def _plan(asset: Asset, painted: Bool[Any, "F"], experiment: FLDMExperiment) -> Plan:
    surface, train, model = experiment.surface, experiment.train, experiment.model
    blocks = sum(model.blocks or blocks_for(surface.vertices))
    work = float(surface.vertices) * model.channels * blocks * train.batch
    return Plan(
        papers=(model, train) == (FLDM(), Train()),
        vertices=surface.vertices,
        copies=surface.copies,
        steps=train.steps,
        batch=train.batch,
        ring_pixels=ring_pixels(asset, painted, surface.vertices),
        copy_seconds=COPY_SECONDS * surface.vertices * surface.copies,
        disk_bytes=float(COPY_BYTES) * surface.vertices * surface.copies,
        step_seconds=STEP_SECONDS[model.network or "mixed"] * work,
        train_seconds=STEP_SECONDS[model.network or "mixed"] * work * train.steps,
        train_bytes=BASE_BYTES + STEP_BYTES * work,
    )


def _warnings(report: Report, plan: Plan, overlapping: float, inside_out: int) -> tuple[str, ...]:
    found = []
    if overlapping > 0.01:
        found.append(f"{overlapping:.1%} of the texels shown are shown more than once: they get one colour")
    if report.flat_uv_faces:
        found.append(f"{report.flat_uv_faces:,} faces have no area on the texture: their colour stays a line")
    if inside_out:
        found.append(
            f"{inside_out:,} components are inside out: turn their faces round, pictures show the far side"
        )
    if plan.ring_pixels is not None and plan.ring_pixels[1] < RING_PIXELS[0]:
        found.append(f"{plan.ring_pixels[1]:.0f} pixels in a one-ring: fewer vertices carry the same texture")
    if plan.ring_pixels is not None and plan.ring_pixels[1] > RING_PIXELS[1]:
        found.append(f"{plan.ring_pixels[1]:,.0f} pixels in a one-ring: details are lost, take more vertices")
    if 20 * report.components > plan.vertices:
        found.append(f"{report.components:,} components for {plan.vertices:,} vertices: take more vertices")
    return tuple(found)


def _verdict(report: Report, warnings: int) -> str:
    dropped = report.degenerate_faces + report.ear_faces + report.duplicate_faces
    cut = report.nonmanifold_edges + report.disagreeing_edges + report.nonmanifold_vertices
    done = [
        f"{report.welded_vertices:,} vertices welded" if report.welded_vertices else "",
        f"{dropped:,} faces dropped" if dropped else "",
        f"{cut:,} edges and vertices cut" if cut else "",
    ]
    how = ", ".join(part for part in done if part) or "as it is"
    told = {0: "", 1: "; mind the warning"}.get(warnings, "; mind the warnings")
    return f"flx takes it ({how}){told}"


# --- as text

LINES = (
    ("polygons cut into triangles", "polygons"),
    ("vertices welded by position", "welded_vertices"),
    ("faces dropped: a corner twice", "degenerate_faces"),
    ("faces dropped: doubled ears", "ear_faces"),
    ("faces dropped: duplicates", "duplicate_faces"),
    ("vertices dropped: no face", "unused_vertices"),
    ("edges cut: more than two faces", "nonmanifold_edges"),
    ("edges cut: orientations disagree", "disagreeing_edges"),
    ("vertices cut: several fans", "nonmanifold_vertices"),
    ("vertices added by cuts", "split_vertices"),
    ("sliver faces, kept", "sliver_faces"),
    ("faces without area on the texture", "flat_uv_faces"),
    ("faces that leave [0, 1], repeated", "outside_uv_faces"),
)


def describe(report: Report, findings: Findings | None = None) -> str:
    """Lines of text; repairs that were not needed are left out. The verdict comes last."""
    lines = [
        ("file", f"{report.path} ({report.format}), {report.parts} parts, {report.materials} materials"),
        ("read", f"{report.vertices_read:,} vertices, {report.faces_read:,} faces"),
        *((label, f"{getattr(report, key):,}") for label, key in LINES if getattr(report, key)),
        ("mesh", f"{report.vertices:,} vertices, {report.faces:,} faces, {report.components} components"),
        ("boundary", f"{report.boundary_edges:,} edges in {report.boundary_loops} loops"),
        ("Euler characteristic", str(report.euler)),
        ("colour", report.color_source),
        *(("texture", name) for name in report.textures),
        *(("image found under another name", name) for name in report.found_images),
        *(("other map, not here, left alone", name) for name in report.missing_images),
        *(("option of map_Kd, kept, not applied", option) for option in report.ignored_options),
        *(("in the file, not read", what) for what in report.unread),
        *(_describe_findings(findings) if findings else ()),
    ]
    width = max(len(label) for label, _ in lines)
    return "\n".join(f"{label:<{width}}  {value}" for label, value in lines)


def _describe_findings(findings: Findings) -> list[tuple[str, str]]:
    plan, lines = findings.plan, []
    if findings.covered_texels:
        told = (
            f"{findings.covered_texels:.0%} shown, {findings.overlapping_texels:.1%} of that more than once"
        )
        lines.append(("texels", told))
    if plan.ring_pixels is not None:
        low, median, high = plan.ring_pixels
        told = f"{median:,.0f} (5 %: {low:,.0f}, 95 %: {high:,.0f}) at {plan.vertices:,} vertices"
        lines.append(("pixels in a one-ring", told))
    told = f"{plan.copies:,} copies, {plan.steps:,} steps of {plan.batch}, {plan.vertices:,} vertices"
    lines.append(("planned run", f"the paper's; say --config for yours: {told}" if plan.papers else told))
    told = f"{_time(plan.copy_seconds)} for the copies, {_time(plan.train_seconds)} to train"
    lines.append(("its time on two CPU cores, about", told))
    told = f"{plan.train_bytes / 1e9:,.1f} GB of memory, {plan.disk_bytes / 1e9:,.1f} GB on disk"
    lines.append(("its size, about", told))
    return [*lines, *(("warning", text) for text in findings.warnings), ("verdict", findings.verdict)]


def _time(seconds: float) -> str:
    for unit, size in (("days", 86400.0), ("hours", 3600.0), ("minutes", 60.0)):
        if seconds >= 2 * size:
            return f"{seconds / size:,.0f} {unit}"
    return f"{seconds:.0f} s"
