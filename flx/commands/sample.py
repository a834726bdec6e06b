"""`flx sample`: new textures from a trained generator."""

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal, NamedTuple

from tqdm import tqdm
from tyro.conf import OmitArgPrefixes, Positional

from flx.arguments import whole
from flx.assets.asset import Asset, Format, Painting
from flx.commands.output import digests, own_folder, settings
from flx.commands.stages import Stages
from flx.config import STEPS, Sampler
from flx.controls import Controls, Patches
from flx.files import write_atomically
from flx.types import SLOTS


@dataclass(frozen=True)
class Sample:
    """Make new textures: variation_00.glb and more, their atlases, a contact sheet, a page and samples.json.

    Example: flx sample runs/demo --count 4
             flx sample bowl.glb --instant      without training, from pieces of its own texture
    """

    # a run folder of `flx train`, or a generator.safetensors; with --instant, also a mesh file, or
    # nothing for the vase that flx makes itself
    run: Positional[Path | None] = None
    instant: bool = False  # pieces of the input's own texture: no training, all maps of the material
    # with --instant: an image to use instead of the mesh file's own, or where it has none
    texture: Path | None = None
    count: int = 4  # number of variations
    seed: int = 0  # variation n depends on the seed and n alone
    # folder to write to; else RUN/samples, with the options in its name that are not the usual ones
    out: Path | None = None
    texture_size: int | None = None  # pixels on the longer side; the input's, at most 2048, unless given
    # "glb" keeps everything that a GLB or glTF held, "obj" everything of an OBJ; "ply" holds vertex colours
    format: Format = "glb"
    variants: bool = False  # write one GLB, variants.glb, with all variations as material variants
    steps: int = STEPS  # evaluations of the network; "ancestral" takes all steps of the schedule instead
    sampler: Sampler = "dpm"  # "dpm" is of second order, "ddim" of first; "ancestral" is DDPM
    up: Literal["y", "z"] | None = None  # the axis that points up in the pictures; as in the run
    viewer: bool = True  # write viewer.html: all of them in 3D, one file that needs no network
    beside: Path | None = None  # a folder of other variations, shown in the picture and on the page too
    controls: OmitArgPrefixes[Controls] = field(default_factory=Controls)
    patches: OmitArgPrefixes[Patches] = field(default_factory=Patches)

    def __call__(self) -> None:
        from flx.commands.viewer import name_viewer

        out = sample(self)
        print(out, flush=True)
        if self.viewer:
            name_viewer(out)


class Plan(NamedTuple):
    """What variations are made of, and where they go."""

    own: Asset  # whose texture is varied
    asset: Asset  # what is painted
    file: Asset  # the same as it was read, before it got an atlas of its own
    up: Literal["y", "z"]
    kept: Any  # `flx.pipeline.masks.Kept` or None
    usual: Path  # the folder, if no other options are given
    also: str  # what tells it from another call's
    made_by: dict[str, Any]  # what the files depend on, beside the options
    vertices: int
    paint: Callable[[], Iterator[tuple[Painting, dict[str, Any]]]]  # each with what the record says of it


def sample(options: Sample) -> Path:
    """Write the variations, each file whole or not at all; return their folder.

    Raises ValueError where there is nothing to make them of, or the output cannot be written.
    """
    from flx.assets.preflight import check_output
    from flx.assets.variants import check_variants, write_variants
    from flx.assets.write import write, write_atlases, write_png
    from flx.commands.beside import beside
    from flx.commands.viewer import write_viewer
    from flx.geometry.seams import border_ratio, seam_ratio
    from flx.pipeline.canvas import check_size, shown, side_by_side
    from flx.pipeline.direction import file_of
    from flx.stopping import keeping
    from flx.viewer.page import NAME, shot

    check_size(options.texture_size)
    whole("--seed", options.seed)
    for name in ("count", "steps"):
        whole(f"--{name}", getattr(options, name), 1)
    plan = instant_plan(options) if options.instant else learnt_plan(options)
    own, asset, kept = plan.own, plan.asset, plan.kept
    others = beside(options.beside, asset) if options.beside else {}
    if options.variants:
        check_variants(asset, options.format)
    read = {name: getattr(options.controls, name) for name in ("keep", "fill", "labels")}
    read["direction"] = file_of(options.controls.direction or "x")
    unused = {"steps", "sampler", "invention"} if options.instant else {f.name for f in fields(Patches)}
    made_by = {
        **{name: value for name, value in settings(options).items() if name not in unused},
        **plan.made_by,
        **digests({**read, "texture": options.texture}),
    }
    titles = [f"variation {n:02d}" for n in range(options.count)]
    stems = ["variants"] if options.variants else [title.replace(" ", "_") for title in titles]
    names = [f"{stem}.{options.format}" for stem in stems]
    sheet = "contact_sheet.png"
    pictures = [sheet, NAME] if options.viewer else [sheet]
    out, before = own_folder(options, plan.usual, plan.also, "samples.json", made_by, [*names, *pictures])
    files = [out / name for name in names]
    check_output(plan.file, options.format, files, [out / name for name in pictures])
    stay = [slot.replace("_", " ") for slot in SLOTS if plan.file.map_names.get(slot)]
    if options.format == "glb" and stay and (why := why_maps_stay(options)):
        print(f"{plan.file.path.name}: {', '.join(stay)} maps stay as they are: {why}", file=sys.stderr)

    record = {
        "run": str(options.run or "the vase of flx"),
        "vertices": plan.vertices,
        **made_by,
        "seam_ratio_input": seam_ratio((asset if plan.file is own else own).mesh),
    }
    if kept:
        record["border_ratio_input"] = border_ratio(own.mesh, kept.index, kept.texels)
    lists = {key: before[key] for key in _DETAILS if key in before}
    details: dict[str, dict[str, Any]] = {
        name: {key: said[place] for key, said in lists.items() if place < len(said)}
        for place, name in enumerate(before.get("files", []))
    }
    made = plan.paint()  # what still refuses does so before anything is written
    _write_record(out, record, list(details), details)  # first: it says whose files these are
    bar = tqdm(made, "variations", options.count, unit="texture", dynamic_ncols=True)
    variations: list[Painting] = []  # what the contact sheet shows
    shots = [shot("input", own)]  # what the page shows, and after these the others

    def noted(names: Sequence[str]) -> Iterator[Painting]:
        for name, (baked, said) in zip(names, bar, strict=True):
            textured = shown(asset, baked)
            details[name] = {"seam_ratios": seam_ratio(textured), **said}
            if kept:
                there = kept.at_size(*baked.images[kept.index].shape[:2])
                details[name]["border_ratios"] = border_ratio(textured, there.index, there.texels)
            variations.extend([baked] if len(variations) < 8 else [])
            if options.viewer:
                file = files[0].name if options.variants else name
                shots.append(shot(titles[len(shots) - 1], asset, baked, file))
            yield baked

    if options.variants:
        keeping(lambda: f"{names[0]} is written when all variations are made; the same command starts again")
        details.clear()
        write_variants(asset, zip(titles, noted(titles), strict=True), files[0])
        _write_record(out, record, names, details)
    else:
        keeping(lambda: f"{len(details)} variations are kept in {out}; the same command makes all of them")
        for file, baked in zip(files, noted(names), strict=True):
            write(asset, baked, file)
            write_atlases(asset, baked, file)
            _write_record(out, record, list(details), details)
    shots += [shot(title, asset, painting) for title, painting in others.items()]
    shown_titles = [*captions(titles, len(variations)), *others]
    every = [*variations, *others.values()]
    write_png(out / sheet, side_by_side(asset, every, shown_titles, plan.up, own=own))
    if options.viewer:
        title = f"{asset.path.name}: {len(titles)} variation{'s' * (len(titles) > 1)}"
        said = {
            "seed": options.seed,
            "run": options.run or "the vase of flx",
            "vertices": plan.vertices,
            **made_by,
        }
        write_viewer(out, title, shots, said, plan.up)
    return out


def why_maps_stay(options: Sample) -> str:
    """Why the other maps of a GLB do not follow its new colours; "" where they do."""
    if options.controls.mesh:
        return "they are those of that mesh"
    if options.variants:
        return "variants share them"
    if not options.instant and options.controls.invented == 1:
        return "they follow pieces, which --strength and --invention 1 do without"
    return ""


def learnt_plan(options: Sample) -> Plan:
    """Variations by a trained generator."""
    from flx.assets.formats.readers import READERS
    from flx.assets.shape import read_shape
    from flx.assets.unwrap import prepared_for
    from flx.fields.samplers import sampler_named
    from flx.pipeline.codec import digest_of
    from flx.pipeline.inpainting import REPEATS
    from flx.pipeline.masks import kept_texels
    from flx.pipeline.transfer import vertex_count
    from flx.pipeline.variations import check_controls, generate
    from flx.training.load import load_generator

    if options.patches != Patches():
        odd = next(f.name for f in fields(Patches) if getattr(options.patches, f.name) != f.default)
        raise ValueError(f"{odd} is {getattr(options.patches, odd)}, which goes with --instant; add that")
    if options.texture is not None:
        raise ValueError(f"texture {options.texture} goes with --instant and a mesh file; leave it out")
    if options.run is None:
        raise ValueError(
            "there is no RUN; name a run folder of `flx train`, or add --instant for the vase of flx"
        )
    if options.run.suffix.lower() in READERS:
        raise ValueError(
            f"{options.run} is a mesh; add --instant to make textures without training, or train first: "
            f"flx train {options.run}"
        )
    generator = load_generator(options.run)
    kept = kept_texels(generator.asset, options.controls)
    decided = min(options.controls.strength, options.controls.invented)
    rules = (decided, REPEATS if kept else None)
    chosen = sampler_named(options.sampler, generator.alphas, options.steps, *rules)
    other = options.controls.mesh and read_shape(options.controls.mesh, options.format)
    follow = options.format == "glb" and not why_maps_stay(options)
    own = generator.asset_with_maps if follow else generator.asset
    asset = prepared_for(other or own, options.format)
    check_controls(generator, options.controls, asset)

    def paint() -> Iterator[tuple[Painting, dict[str, Any]]]:
        if options.controls.invented < 1:
            Stages(1)("looking at the texture, coarse and fine")
        rules = (options.count, options.seed, options.steps, options.sampler, options.texture_size, asset)
        return ((painting, {}) for painting in generate(generator, *rules, options.controls, None))

    home = options.run if options.run.is_dir() else options.run.parent
    return Plan(
        own=own,
        asset=asset,
        file=other or own,
        up=options.up or generator.experiment.surface.up,
        kept=kept,
        usual=home / "samples",
        also=f"step-{generator.step}",
        made_by={
            "steps": len(chosen.table["t"]),
            "invention": options.controls.invented if options.controls.strength == 1 else None,
            "step": generator.step,
            "generator": digest_of(generator.params)[:12],
        },
        vertices=vertex_count(generator, asset, options.controls.scale),
        paint=paint,
    )


def instant_plan(options: Sample) -> Plan:
    """Variations from pieces of the input, without training."""
    from flx.assets.formats.readers import READERS
    from flx.assets.read import OTHERS, read_asset, read_with_maps
    from flx.assets.shape import read_shape
    from flx.assets.unwrap import prepared_for
    from flx.assets.vase import vase_asset
    from flx.pipeline.instant import check_instant, open_canvases, painted, patch_generator
    from flx.pipeline.layout import run_guides
    from flx.pipeline.masks import kept_texels
    from flx.pipeline.transfer import in_words, scaled_count
    from flx.training.load import load_generator

    if options.texture and (options.run is None or options.run.is_dir()):
        raise ValueError(f"texture {options.texture} goes with a mesh file; name one, or leave it out")
    if options.steps != STEPS or options.sampler != "dpm":
        raise ValueError("there is no network to evaluate with --instant; leave out --steps and --sampler")
    up: Literal["y", "z"] = "y"
    generator = None
    if options.run is None:
        own, usual = vase_asset(), Path("runs", "vase-instant")
    elif options.run.suffix.lower() in {*READERS, *OTHERS}:
        maps = options.format == "glb" and not why_maps_stay(options)
        own = (read_with_maps if maps else read_asset)(options.run, options.texture)
        usual = Path("runs", f"{options.run.stem}-instant")
    else:
        generator = load_generator(options.run)
        own, up = generator.asset, generator.experiment.surface.up
        usual = (options.run if options.run.is_dir() else options.run.parent) / "instant"
    kept = kept_texels(own, options.controls)
    other = options.controls.mesh and read_shape(options.controls.mesh, options.format)
    asset = prepared_for(other or own, options.format)
    guides = run_guides(generator, asset, options.patches, options.controls) if generator else None
    check_instant(options.patches, options.controls, guides)
    if other or options.controls.scale != 1:
        print(in_words(options.patches.vertices, own, asset, options.controls.scale), file=sys.stderr)

    def paint() -> Iterator[tuple[Painting, dict[str, Any]]]:
        stages = Stages(2)
        stages("looking at the texture, coarse and fine")
        intact = generator.intact if generator else None
        patches = patch_generator(own, options.patches, 0, options.controls, asset, guides, intact)
        stages("finding texels on the surface")
        canvases = open_canvases(patches, options.texture_size)
        every = patches.every([[options.seed, n] for n in range(options.count)], None)
        return (
            (painted(patches, canvases, anchors), {"pieces": patches.pieces(anchors)._asdict()})
            for anchors in every
        )

    return Plan(
        own=own,
        asset=asset,
        file=other or own,
        up=options.up or up,
        kept=kept,
        usual=usual,
        also=own.digest[:8],
        made_by={"method": "instant", "asset": own.digest[:12]},
        vertices=scaled_count(options.patches.vertices, own, asset, options.controls.scale),
        paint=paint,
    )


def captions(titles: Sequence[str], count: int) -> list[str]:
    """The first titles, for a sheet that shows so many; the last one says where there are more."""
    more = f" ({count} of {len(titles)} shown)" * (count < len(titles))
    return [*titles[: count - 1], titles[count - 1] + more]


_DETAILS = ("seam_ratios", "border_ratios", "pieces")  # what the record says of each file, as lists


def _write_record(
    out: Path, record: dict[str, Any], files: list[str], details: dict[str, dict[str, Any]]
) -> None:
    """samples.json: the files that are there, and of each variation how its seams and borders are."""
    content = {**record, "files": files}
    for key in _DETAILS:
        if key == "seam_ratios" or any(key in said for said in details.values()):
            content[key] = [said.get(key) for said in details.values()]
    write_atomically(out / "samples.json", (json.dumps(content, indent=2) + "\n").encode())
