"""`flx sample`: new textures from a trained generator."""

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from tqdm import tqdm
from tyro.conf import OmitArgPrefixes, Positional

from flx.assets.asset import Format, Painting
from flx.commands.output import own_folder, settings
from flx.config import STEPS, Controls, Sampler
from flx.files import write_atomically


@dataclass(frozen=True)
class Sample:
    """Make new textures: variation_00.glb and more, their atlases, a contact sheet and samples.json.

    Example: flx sample runs/demo --count 4
    """

    run: Positional[Path]  # a run folder of `flx train`, or a generator.safetensors
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
    up: Literal["y", "z"] | None = None  # the axis that points up in the contact sheet; as in the run
    controls: OmitArgPrefixes[Controls] = field(default_factory=Controls)

    def __call__(self) -> None:
        print(sample(self))


def sample(options: Sample) -> Path:
    """Write the variations, each file whole or not at all; return their folder.

    Raises ValueError where there is no trained FLDM, or the output cannot be written.
    """
    from flx.assets.preflight import check_output
    from flx.assets.shape import read_shape
    from flx.assets.unwrap import prepared_for
    from flx.assets.variants import check_variants, write_variants
    from flx.assets.write import write, write_atlases, write_png
    from flx.geometry.seams import border_ratio, seam_ratio
    from flx.pipeline.canvas import check_size, shown, side_by_side
    from flx.pipeline.codec import digest_of
    from flx.pipeline.direction import file_of
    from flx.pipeline.generator import sampler_named
    from flx.pipeline.inpainting import REPEATS, kept_texels
    from flx.pipeline.transfer import vertex_count
    from flx.pipeline.variations import check_direction, check_labels, generate
    from flx.stopping import keeping
    from flx.training.load import load_generator

    check_size(options.texture_size)
    if options.count < 1 or options.steps < 1:
        raise ValueError(f"{options.count} variations in {options.steps} steps; give at least one of each")
    generator = load_generator(options.run)
    kept = kept_texels(generator.asset, options.controls)
    rules = (options.controls.strength, REPEATS if kept else None)
    chosen = sampler_named(options.sampler, generator.alphas, options.steps, *rules)
    other = options.controls.mesh and read_shape(options.controls.mesh, options.format)
    asset = prepared_for(other or generator.asset, options.format)
    check_labels(generator, options.controls, asset)
    check_direction(generator, options.controls, asset)
    up = options.up or generator.experiment.surface.up
    if options.variants:
        check_variants(asset, options.format)
    read = {name: getattr(options.controls, name) for name in ("keep", "fill", "labels")}
    read["direction"] = file_of(options.controls.direction or "x")
    made_by = {
        **settings(options),
        "steps": len(chosen.table["t"]),
        "step": generator.step,
        "generator": digest_of(generator.params)[:12],
        **{
            f"{name}_digest": hashlib.sha256(path.read_bytes()).hexdigest()[:12]
            for name, path in read.items()
            if path
        },
    }
    home = options.run if options.run.is_dir() else options.run.parent
    titles = [f"variation {n:02d}" for n in range(options.count)]
    stems = ["variants"] if options.variants else [title.replace(" ", "_") for title in titles]
    names = [f"{stem}.{options.format}" for stem in stems]
    also, sheet = f"step-{generator.step}", "contact_sheet.png"
    out, before = own_folder(options, home / "samples", also, "samples.json", made_by, [*names, sheet])
    files = [out / name for name in names]
    check_output(other or generator.asset, options.format, files, [out / sheet])

    record = {
        "run": str(options.run),
        **made_by,
        "vertices": vertex_count(generator, asset, options.controls.scale),
        "seam_ratio_input": seam_ratio((generator.asset if other else asset).mesh),
    }
    ratios = dict(zip(before.get("files", []), before.get("seam_ratios", []), strict=False))
    borders = dict(zip(ratios, before.get("border_ratios", []), strict=False))
    _write_record(out, record, list(ratios), ratios, borders)  # first: it says whose files these are
    rules = (options.count, options.seed, options.steps, options.sampler, options.texture_size, asset)
    made = generate(generator, *rules, options.controls)
    bar = tqdm(made, "variations", options.count, unit="texture", dynamic_ncols=True)
    variations: list[Painting] = []  # what the contact sheet shows

    def noted(names: Sequence[str]) -> Iterator[Painting]:
        for name, baked in zip(names, bar, strict=True):
            textured = shown(asset, baked)
            ratios[name] = seam_ratio(textured)
            if kept:
                there = kept.at_size(*baked.images[kept.index].shape[:2])
                borders[name] = border_ratio(textured, there.index, there.texels)
            variations.extend([baked] if len(variations) < 8 else [])
            yield baked

    if options.variants:
        keeping(lambda: f"{names[0]} is written when all variations are made; the same command starts again")
        ratios.clear()
        write_variants(asset, zip(titles, noted(titles), strict=True), files[0])
        _write_record(out, record, names, ratios, borders)
    else:
        keeping(lambda: f"{len(ratios)} variations are kept in {out}; the same command makes all of them")
        for file, baked in zip(files, noted(names), strict=True):
            write(asset, baked, file)
            write_atlases(asset, baked, file)
            _write_record(out, record, list(ratios), ratios, borders)
    shown_titles = captions(titles, len(variations))
    write_png(out / sheet, side_by_side(asset, variations, shown_titles, up, own=generator.asset))
    return out


def captions(titles: Sequence[str], count: int) -> list[str]:
    """The first titles, for a sheet that shows so many; the last one says where there are more."""
    more = f" ({count} of {len(titles)} shown)" * (count < len(titles))
    return [*titles[: count - 1], titles[count - 1] + more]


def _write_record(
    out: Path,
    record: dict[str, Any],
    files: list[str],
    ratios: dict[str, float | None],
    borders: dict[str, float | None],
) -> None:
    """samples.json: the files that are there, and of each variation the ratios at seams and at borders."""
    content = {**record, "files": files, "seam_ratios": list(ratios.values())}
    content |= {"border_ratios": list(borders.values())} if borders else {}
    write_atomically(out / "samples.json", (json.dumps(content, indent=2) + "\n").encode())
