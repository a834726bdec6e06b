"""`flx sample`: new textures from a trained generator."""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

from tqdm import tqdm
from tyro.conf import OmitArgPrefixes, Positional

from flx.assets.asset import Format
from flx.config import STEPS, Controls, Sampler


@dataclass(frozen=True)
class Sample:
    """Make new textures: variation_00.glb and more, their atlases, a contact sheet and samples.json.

    Example: flx sample runs/demo --count 4
    """

    run: Positional[Path]  # a run folder of `flx train`, or a generator.safetensors
    count: int = 4  # number of variations
    seed: int = 0  # variation n depends on the seed and n alone
    out: Path | None = None  # folder to write to; RUN/samples unless given
    texture_size: int | None = None  # pixels on the longer side; the input's, at most 2048, unless given
    # "glb" keeps everything that a GLB or glTF held, "obj" everything of an OBJ; "ply" holds vertex colours
    format: Format = "glb"
    steps: int = STEPS  # evaluations of the network; "ancestral" takes all steps of the schedule instead
    sampler: Sampler = "dpm"  # "dpm" is of second order, "ddim" of first; "ancestral" is DDPM
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
    from flx.files import write_atomically
    from flx.geometry.seams import border_ratio, seam_ratio
    from flx.pipeline.canvas import check_size, shown, side_by_side
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
    out = options.out or (options.run if options.run.is_dir() else options.run.parent) / "samples"
    files = [out / f"variation_{n:02d}.{options.format}" for n in range(options.count)]
    check_output(generator.asset, options.format, files, [out / "contact_sheet.png"])

    asset, up = prepared_for(generator.asset, options.format), generator.experiment.surface.up
    rules = (options.count, options.seed, options.steps, options.sampler, options.texture_size, asset)
    made = generate(generator, *rules, options.controls)
    bar = tqdm(made, "variations", options.count, unit="texture", dynamic_ncols=True)
    variations, ratios, borders = [], [], []
    keeping(
        lambda: (
            f"{len(ratios)} of {options.count} variations are in {out}; the same command makes the same again"
        )
    )
    for file, baked in zip(files, bar, strict=True):
        write(asset, baked, file)
        write_atlases(asset, baked, file)
        ratios.append(seam_ratio(shown(asset, baked)))
        if kept:
            there = kept.at_size(*baked.images[kept.index].shape[:2])
            borders.append(border_ratio(shown(asset, baked), there.index, there.texels))
        variations = [*variations, baked][:8]  # what the contact sheet shows
    names = [f"variation {n:02d}" for n in range(len(variations))]
    write_png(out / "contact_sheet.png", side_by_side(asset, variations, names, up))
    record = {
        "run": str(options.run),
        "step": generator.step,
        "seed": options.seed,
        "sampler": options.sampler,
        "steps": len(chosen.table["t"]),
        "controls": asdict(options.controls),
        "vertices": len(generator.home.triangulation.vertices),
        "seam_ratios": ratios,
        "seam_ratio_input": seam_ratio(asset.mesh),
        "border_ratios": borders,
        "files": [file.name for file in files],
    }
    write_atomically(out / "samples.json", (json.dumps(record, indent=2, default=str) + "\n").encode())
    return out
