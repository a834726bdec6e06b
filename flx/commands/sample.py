"""`flx sample`: new textures from a trained generator."""

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

from tqdm import tqdm
from tyro.conf import OmitArgPrefixes, Positional

from flx.assets.asset import Format, Painting
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
    variants: bool = False  # write one GLB, variants.glb, with all variations as material variants
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
    from flx.assets.shape import read_shape
    from flx.assets.unwrap import prepared_for
    from flx.assets.variants import check_variants, write_variants
    from flx.assets.write import write, write_atlases, write_png
    from flx.files import write_atomically
    from flx.geometry.seams import seam_ratio
    from flx.pipeline.canvas import check_size, shown, side_by_side
    from flx.pipeline.generator import sampler_named
    from flx.pipeline.transfer import vertex_count
    from flx.pipeline.variations import generate
    from flx.training.load import load_generator

    check_size(options.texture_size)
    if options.count < 1 or options.steps < 1:
        raise ValueError(f"{options.count} variations in {options.steps} steps; give at least one of each")
    generator = load_generator(options.run)
    strength = options.controls.strength
    chosen = sampler_named(options.sampler, generator.alphas, options.steps, strength)
    out = options.out or (options.run if options.run.is_dir() else options.run.parent) / "samples"
    names = [f"variation {n:02d}" for n in range(options.count)]
    stems = ["variants"] if options.variants else [name.replace(" ", "_") for name in names]
    files = [out / f"{stem}.{options.format}" for stem in stems]
    other = options.controls.mesh and read_shape(options.controls.mesh, options.format)
    check_output(other or generator.asset, options.format, files, [out / "contact_sheet.png"])

    asset, up = prepared_for(other or generator.asset, options.format), generator.experiment.surface.up
    if options.variants:
        check_variants(asset, options.format)
    rules = (options.count, options.seed, options.steps, options.sampler, options.texture_size, asset)
    made = generate(generator, *rules, options.controls)
    bar = tqdm(made, "variations", options.count, unit="texture", dynamic_ncols=True)
    variations, ratios = [], []

    def noted() -> Iterator[Painting]:
        for baked in bar:
            ratios.append(seam_ratio(shown(asset, baked)))
            variations.extend([baked] if len(variations) < 8 else [])  # what the contact sheet shows
            yield baked

    if options.variants:
        write_variants(asset, zip(names, noted(), strict=True), files[0])
    else:
        for file, baked in zip(files, noted(), strict=True):
            write(asset, baked, file)
            write_atlases(asset, baked, file)
    sheet = side_by_side(asset, variations, names[: len(variations)], up, own=generator.asset)
    write_png(out / "contact_sheet.png", sheet)
    record = {
        "run": str(options.run),
        "step": generator.step,
        "seed": options.seed,
        "sampler": options.sampler,
        "steps": len(chosen.table["t"]),
        "controls": asdict(options.controls),
        "vertices": vertex_count(generator, asset, options.controls.scale),
        "seam_ratios": ratios,
        "seam_ratio_input": seam_ratio((generator.asset if other else asset).mesh),
        "files": [file.name for file in files],
    }
    write_atomically(out / "samples.json", (json.dumps(record, indent=2) + "\n").encode())
    return out
