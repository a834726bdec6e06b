"""`flx sample`: new textures from a trained generator."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from tqdm import tqdm
from tyro.conf import OmitArgPrefixes, Positional

from flx.assets.asset import Format
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
    from flx.assets.unwrap import prepared_for
    from flx.assets.write import write, write_atlases, write_png
    from flx.geometry.seams import border_ratio, seam_ratio
    from flx.pipeline.canvas import check_size, shown, side_by_side
    from flx.pipeline.codec import digest_of
    from flx.pipeline.generator import sampler_named
    from flx.pipeline.inpainting import REPEATS, kept_texels
    from flx.pipeline.variations import generate
    from flx.stopping import keeping
    from flx.training.load import load_generator

    check_size(options.texture_size)
    if options.count < 1 or options.steps < 1:
        raise ValueError(f"{options.count} variations in {options.steps} steps; give at least one of each")
    generator = load_generator(options.run)
    kept = kept_texels(generator.asset, options.controls)
    rules = (options.controls.strength, REPEATS if kept else None)
    chosen = sampler_named(options.sampler, generator.alphas, options.steps, *rules)
    made_by = {
        **settings(options),
        "steps": len(chosen.table["t"]),
        "step": generator.step,
        "generator": digest_of(generator.params)[:12],
    }
    home = options.run if options.run.is_dir() else options.run.parent
    names = [f"variation_{n:02d}.{options.format}" for n in range(options.count)]
    also, sheet = f"step-{generator.step}", "contact_sheet.png"
    place = (home / "samples", also, "samples.json", made_by, [*names, sheet])
    out, before = own_folder(options, *place)
    files = [out / name for name in names]
    check_output(generator.asset, options.format, files, [out / sheet])

    asset, up = prepared_for(generator.asset, options.format), options.up or generator.experiment.surface.up
    record = {
        "run": str(options.run),
        **made_by,
        "vertices": len(generator.home.triangulation.vertices),
        "seam_ratio_input": seam_ratio(asset.mesh),
    }
    ratios = dict(zip(before.get("files", []), before.get("seam_ratios", []), strict=False))
    borders = dict(zip(ratios, before.get("border_ratios", []), strict=False))
    _write_record(out, record, ratios, borders)  # first: it says whose files these are
    rules = (options.count, options.seed, options.steps, options.sampler, options.texture_size, asset)
    made = generate(generator, *rules, options.controls)
    bar = tqdm(made, "variations", options.count, unit="texture", dynamic_ncols=True)
    variations = []
    keeping(lambda: f"{len(ratios)} variations are kept in {out}; the same command makes all of them")
    for file, baked in zip(files, bar, strict=True):
        write(asset, baked, file)
        write_atlases(asset, baked, file)
        ratios[file.name] = seam_ratio(shown(asset, baked))
        if kept:
            there = kept.at_size(*baked.images[kept.index].shape[:2])
            borders[file.name] = border_ratio(shown(asset, baked), there.index, there.texels)
        _write_record(out, record, ratios, borders)
        variations = [*variations, baked][:8]  # what the contact sheet shows
    titles = [f"variation {n:02d}" for n in range(len(variations))]
    write_png(out / sheet, side_by_side(asset, variations, titles, up))
    return out


def _write_record(
    out: Path, record: dict[str, Any], ratios: dict[str, float | None], borders: dict[str, float | None]
) -> None:
    """samples.json, with the ratios at seams, and at the borders of what is kept, of what is there."""
    content = {**record, "files": list(ratios), "seam_ratios": list(ratios.values())}
    content |= {"border_ratios": list(borders.values())} if borders else {}
    write_atomically(out / "samples.json", (json.dumps(content, indent=2) + "\n").encode())
