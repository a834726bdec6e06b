"""`flx doctor`: what is in a mesh file, what a planned run meets on it, and a verdict.

`read_asset` refuses a mesh that cannot be used; its message is then the verdict.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from tyro.conf import Positional

from flx.assets.assemble import faults_of
from flx.assets.asset import Asset, Report
from flx.assets.detail import Detail, detail, psnr_at, vertices_for
from flx.assets.formats.files import quoted
from flx.assets.inspect import coverage, inside_out_components, ring_pixels, texel_counts
from flx.assets.read import read_asset
from flx.assets.tints import tints_in_words
from flx.config import FLVAE, FLDMExperiment, quick, read_config
from flx.geometry.atlas import check_repeats, uv_areas
from flx.geometry.copies import check_memory
from flx.machine import memory, room
from flx.models.denoiser.depth import complete
from flx.pipeline.direction import read_direction
from flx.pipeline.labels import read_labels
from flx.pipeline.masks import read_damage
from flx.pipeline.weights import read_weights, weights_file
from flx.training.costs import Costs, costs_of
from flx.types import SLOTS

LEAST_PIXELS = 7.0  # in a one-ring, 1.5 from the vertex: the FL-VAE was trained on no fewer
FINE, COARSE = 30.0, 25.0  # dB at which small letters are kept, and below which a warning is given


@dataclass(frozen=True)
class Doctor:
    """Say what is in a mesh file, what would be repaired and what a run would take. Writes nothing.

    Example: flx doctor bowl.glb --config experiments/bowl.py
    """

    mesh: Positional[Path]  # a .glb, .gltf, .obj or .ply file
    texture: Path | None = None  # an image to use instead of the file's own
    config: Path | None = None  # plan this config's run; without it, that of `flx train MESH`
    vertices: int | None = None  # plan a run with so many vertices
    json: bool = False  # print one JSON object

    def __call__(self) -> None:
        plan = quick() if self.config is None else read_config(self.config)
        if not isinstance(plan, FLDMExperiment):
            raise ValueError(f"{self.config} trains on no mesh; give a config such as experiments/demo.py")
        if self.vertices is not None:
            plan = replace(plan, surface=replace(plan.surface, vertices=self.vertices))
        try:
            codec = _codec(plan)
            check_memory(plan.surface.vertices, plan.surface.copies)
            asset = read_asset(self.mesh, self.texture)
            labels = plan.surface.labels and read_labels(Path(plan.surface.labels), asset)
            directed = plan.surface.direction and read_direction(plan.surface.direction, asset)
            if plan.surface.fill:
                read_damage(Path(plan.surface.fill), asset)
            count = len(labels.palette) if labels else 0
            complete(plan.model, codec, plan.surface.vertices, count, int(bool(directed)))
            with faults_of(asset.path):
                check_repeats(asset.mesh)
        except (ValueError, OSError) as refusal:
            if self.json:
                print(json.dumps({"path": str(self.mesh), "verdict": f"refused: {refusal}"}, indent=2))
            raise
        findings = examine(asset, plan)
        record = {**asset.report._asdict(), **findings._asdict(), "plan": findings.plan._asdict()}
        print(json.dumps(record, indent=2) if self.json else describe(asset.report, findings))


def _codec(plan: FLDMExperiment) -> FLVAE:
    """The configuration of the FL-VAE that the plan uses."""
    return read_weights(weights_file(plan.weights))[0]


RingPixels = tuple[float, float, float] | None  # in a one-ring: 5th percentile, median and 95th by area


class Findings(NamedTuple):
    """What is right or wrong with a mesh that can be used. Plain numbers and words, for JSON."""

    inside_out_components: int  # closed, and their faces look inwards
    mirrored_uv_faces: int  # seen from behind on their texture; both ways is common, and harmless
    covered_texels: float  # share of the textures that the surface shows
    overlapping_texels: float  # share of these that it shows more than once
    ring_pixels: RingPixels
    kept_psnr: float | None  # of the texture by the plan's vertices, in dB; None where it has no detail
    enough_vertices: int | None  # to keep it at `FINE` dB
    other_maps: tuple[str, ...]  # slots of other maps
    tints: tuple[str, ...]  # materials whose texture viewers multiply, with the factor
    plan: Costs
    warnings: tuple[str, ...]
    verdict: str


def examine(asset: Asset, experiment: FLDMExperiment) -> Findings:
    """What a run of `experiment` would meet on the asset, in addition to the repairs of reading it."""
    counts = texel_counts(asset)
    covered, overlapping = coverage(asset, counts)
    lost = detail(asset, counts)
    flat = np.array([texture.flat for texture in asset.textures] or [True])[asset.mesh.face_textures]
    pixels = ring_pixels(asset, ~flat, experiment.surface.vertices)
    inside_out = inside_out_components(asset)
    plan = costs_of(experiment)
    warnings = (
        *_warnings(asset.report, experiment.surface.vertices, pixels, overlapping, inside_out),
        *_turned(asset),
        *_losses(lost, experiment.surface.vertices),
        *_shortages(plan),
    )
    return Findings(
        inside_out_components=inside_out,
        mirrored_uv_faces=int(((uv_areas(asset.mesh) < 0) & ~flat).sum()),
        covered_texels=covered,
        overlapping_texels=overlapping,
        ring_pixels=pixels,
        kept_psnr=round(psnr_at(lost, experiment.surface.vertices), 1) if lost else None,
        enough_vertices=_enough(lost) if lost else None,
        other_maps=tuple(slot.replace("_", " ") for slot in SLOTS if asset.map_names.get(slot)),
        tints=tuple(tints_in_words(asset)),
        plan=plan,
        warnings=warnings,
        verdict=_verdict(asset.report, len(warnings)),
    )


def _warnings(
    report: Report, vertices: int, pixels: RingPixels, overlapping: float, inside_out: int
) -> tuple[str, ...]:
    flat, components = report.flat_uv_faces, report.components
    median = pixels[1] if pixels else LEAST_PIXELS
    ring = f"{median:,.0f} texture pixels in a one-ring"
    found = (
        (overlapping > 0.01, f"{overlapping:.1%} of texels show more than once: those places share a colour"),
        (flat > 0, f"{flat:,} faces have no area on the texture: they show as a streak"),
        (inside_out > 0, f"{inside_out:,} components are inside out; flip their faces"),
        (median < LEAST_PIXELS, f"only {ring}: fewer vertices would give the same result"),
        (
            max(report.materials, report.parts) > 1,
            f"{_kinds(report)} are learnt as one texture and will mix; labels can keep them apart "
            "(--surface.labels): a PLY, or an image where their UVs do not overlap",
        ),
        (
            20 * components > vertices,
            f"{components:,} components for {vertices:,} vertices; use more vertices",
        ),
    )
    return tuple(text for holds, text in found if holds)


def _enough(lost: Detail) -> int:
    """With how many vertices the texture is kept at `FINE` dB, to two digits."""
    wanted = float(np.clip(vertices_for(lost, FINE), 100, 1e6))
    return int(round(wanted, 1 - int(np.log10(wanted))))


def _kinds(report: Report) -> str:
    return f"{report.materials:,} materials" if report.materials > 1 else f"{report.parts:,} parts"


def _turned(asset: Asset) -> list[str]:
    """Images that some programs turn."""
    names = [texture.name for texture in asset.textures if texture.turned]
    return [
        f"EXIF data turn {quoted(name)}: browsers do so, flx and Blender take it as it is stored; save it "
        "anew, as it should lie"
        for name in names
    ]


def _losses(lost: Detail, vertices: int) -> list[str]:
    """What the vertices of a plan cannot keep."""
    if not lost or (psnr := psnr_at(lost, vertices)) >= COARSE:
        return []
    return [
        f"{vertices:,} vertices keep the texture at about {psnr:.0f} dB: small details are lost; about "
        f"{_enough(lost):,} would keep {FINE:.0f} dB (--surface.vertices of flx train)"
    ]


def _shortages(plan: Costs) -> list[str]:
    """What this machine lacks for a plan."""
    here, free, found = memory(), room(), []
    if here and plan.train_bytes > here.total:
        wanted, there = _size(plan.train_bytes), _size(here.total)
        found.append(
            f"training takes about {wanted} of memory, and this machine has {there}; use fewer "
            "--surface.vertices, --model.channels or a smaller --train.batch of flx train"
        )
    if free is not None and plan.disk_bytes > free:
        wanted, there = _size(plan.disk_bytes), _size(free)
        found.append(
            f"the copies take about {wanted} of disk, and {there} are free here; use fewer --surface.copies"
        )
    return found


def _verdict(report: Report, warnings: int) -> str:
    dropped = report.degenerate_faces + report.ear_faces + report.duplicate_faces
    cut = report.nonmanifold_edges + report.disagreeing_edges + report.nonmanifold_vertices
    repairs = (report.welded_vertices, dropped, cut)
    words = ("vertices welded", "faces dropped", "edges and vertices cut")
    how = ", ".join(f"{n:,} {what}" for n, what in zip(repairs, words, strict=True) if n) or "as it is"
    mind = {0: "", 1: "; mind the warning"}.get(warnings, "; mind the warnings")
    return f"flx takes it ({how}){mind}"


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
    parts, materials = _counted(report.parts, "part"), _counted(report.materials, "material")
    lines = [
        ("file", f"{report.path} ({report.format}), {parts}, {materials}"),
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
        repeated = f"{findings.overlapping_texels:.1%} of that more than once"
        lines.append(("texels", f"{findings.covered_texels:.0%} shown, {repeated}"))
    if findings.ring_pixels is not None:
        low, median, high = findings.ring_pixels
        spread = f"{median:,.0f} (5 %: {low:,.0f}, 95 %: {high:,.0f}) at {plan.vertices:,} vertices"
        lines.append(("pixels in a one-ring", spread))
    if findings.kept_psnr is not None:
        enough = f"{FINE:.0f} dB take about {findings.enough_vertices:,} vertices"
        lines.append(("texture kept, about", f"{findings.kept_psnr:.0f} dB; {enough}"))
    if findings.other_maps:
        names = ", ".join(findings.other_maps)
        lines.append(
            ("other maps", f"{names}; they follow new colours into a GLB, but not with --variants or --mesh")
        )
    lines += [("viewers multiply the texture of", tint) for tint in findings.tints]
    size = f"{plan.copies:,} copies, {plan.steps:,} steps of {plan.batch}, {plan.vertices:,} vertices"
    duration = (
        f"{_time(plan.copy_seconds)} for the copies, {_time(plan.compile_seconds)} to compile, "
        f"{_time(plan.train_seconds)} to train"
    )
    here, free = memory(), room()
    has = f" (this machine has {_size(here.total)})" if here else ""
    spare = "" if free is None else f" ({_size(free)} free here)"
    sizes = f"{_size(plan.train_bytes)} of memory{has}, {_size(plan.disk_bytes)} on disk{spare}"
    plans = [
        ("planned run", size),
        ("its time on two CPU cores, about", duration),
        ("its size, about", sizes),
    ]
    warnings = [("warning", text) for text in findings.warnings]
    return [*lines, *plans, *warnings, ("verdict", findings.verdict)]


def _counted(count: int, what: str) -> str:
    return f"{count:,} {what}{'s' * (count != 1)}"


def _size(count: float) -> str:
    return f"{count / 1e9:,.1f} GB" if count >= 1e9 else f"{count / 1e6:,.0f} MB"


def _time(seconds: float) -> str:
    for unit, size in (("days", 86400.0), ("hours", 3600.0), ("minutes", 60.0)):
        if seconds >= 2 * size:
            return f"{seconds / size:,.0f} {unit}"
    return f"{seconds:.0f} s"
