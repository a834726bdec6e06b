"""`flx evaluate`: how good samples are, or how well each method keeps the textures of some meshes."""

import json
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from tqdm import tqdm
from tyro.conf import Positional

from flx.arguments import whole
from flx.commands.output import digest, digests, own_folder, settings
from flx.commands.stages import Stages
from flx.config import STEPS, Comparison, Sampler
from flx.controls import Controls, Patches
from flx.types import TexturedMesh

JUDGED = ("texture_size", "seed")  # the fields of a comparison that samples are judged by, too
# Options that what is judged does not depend on, or that are recorded otherwise.
APART = ("source", "instant", *(f.name for f in fields(Comparison) if f.name not in JUDGED))


@dataclass(frozen=True)
class Evaluate(Comparison):
    """Judge samples: fidelity, coverage, copying, diversity, as evaluation.html and evaluation.json.

    flx evaluate runs/demo                                makes variations of a run and judges them
    flx evaluate INPUT.glb --samples A.glb B.glb          judges any meshes against an input
    flx evaluate INPUT.glb --instant                      makes variations without training and judges them
    flx evaluate --reconstruction bowl.glb --out table    measures codecs: table.json and table.md
    """

    source: Positional[Path | None] = None  # a run folder, a generator.safetensors, or the input's mesh file
    samples: tuple[Path, ...] = ()  # mesh files to judge; without them the run makes variations
    count: int = 4  # variations that the run makes
    steps: int = STEPS  # evaluations of the network for each
    sampler: Sampler = "dpm"  # as of `flx sample`
    invention: float | None = None  # as of `flx sample`: 1 is the network alone
    # variations without training, of a mesh file, of a run, or of the vase that flx makes itself
    instant: bool = False
    labels: Path | None = None  # as of `flx sample`: what goes where; also, how well that is followed
    input_labels: Path | None = None  # with --instant, as of `flx sample`
    height: str | None = None  # as of `flx sample`: pieces stay at their height along x, y or z

    def __call__(self) -> None:
        if self.source is None and not self.instant:
            from flx.evaluation.reconstruction import markdown, reconstruction_table

            print(markdown(reconstruction_table(self)), end="")
        else:
            print(judge(self, self.source))


def judge(options: Evaluate, source: Path | None) -> Path:
    """Write the page and the numbers; return the page. Without a source it is the vase of flx.

    Raises ValueError for what cannot be read, and for a mesh file without samples.
    """
    from flx.assets.read import read_asset
    from flx.assets.vase import vase_asset
    from flx.evaluation.controls import controls
    from flx.evaluation.labels import labels_followed
    from flx.evaluation.report import page
    from flx.evaluation.samples import judge_samples
    from flx.files import write_atomically
    from flx.geometry.render import contact_sheet, render
    from flx.pipeline.canvas import VIEWS, check_size, shown
    from flx.pipeline.codec import digest_of
    from flx.pipeline.instant import patch_generator, patchworks
    from flx.pipeline.layout import asked_labels, run_guides
    from flx.pipeline.transfer import LEAST
    from flx.pipeline.variations import generate, reconstruct
    from flx.training.load import load_generator

    if options.instant and (options.samples or options.invention is not None):
        raise ValueError("--instant makes its samples without a network; leave out --samples and --invention")
    if options.input_labels and not options.instant:
        raise ValueError(f"input labels {options.input_labels} go with --instant; add that, or leave it out")
    for name in ("labels", "height"):
        if options.samples and (value := getattr(options, name)):
            raise ValueError(f"{name} {value} is for samples that flx makes; leave out --{name} or --samples")
    if options.reconstruction:
        raise ValueError(f"give {source} or --reconstruction, not both: they measure different things")
    for name in ("count", "steps"):
        whole(f"--{name}", getattr(options, name), 1)
    size, others, up = options.texture_size or 1024, {}, "y"
    check_size(size)
    if len({path.stem for path in options.samples}) < len(options.samples):
        raise ValueError("two files of --samples have the same name; rename one: rows are named after files")
    stage = Stages(2 if options.samples else 3)
    samples = {path.stem: read_asset(path).mesh for path in options.samples}
    generator, home = None, Path()
    if source and (source.is_dir() or source.suffix == ".safetensors"):
        generator = load_generator(source)
        asset, up = generator.asset, generator.experiment.surface.up
        home = source if source.is_dir() else source.parent
    elif not (samples or options.instant):
        raise ValueError(
            f"{source} is a mesh; name the meshes to judge after --samples, add --instant, or give a run"
        )
    else:
        asset = read_asset(source) if source else vase_asset()
    count = max(len(generator.home.triangulation.vertices), LEAST) if generator else Patches().vertices
    patches, asked, unguided = Patches(vertices=count, input_labels=options.input_labels), None, {}
    if not samples:
        asked = asked_labels(generator and generator.labelled, asset, patches, options.labels)
    invented = Controls(invention=options.invention, height=options.height).invented
    made_by = {
        **settings(options, APART),
        "instant": options.instant,
        "invention": None if options.instant else invented,
        "asset": asset.digest[:12],
        "generator": digest_of(generator.params)[:12] if generator else None,
        "digests": [digest(path) for path in options.samples],
        **digests({"labels": options.labels, "input_labels": options.input_labels}),
    }
    usual = home / ("evaluation-instant" if options.instant else "evaluation")
    also = f"step-{generator.step}" if generator else asset.digest[:8]
    out, _ = own_folder(options, usual, also, "evaluation.json", made_by, ["evaluation.html"], APART)
    if generator and not samples:
        others["codec"] = shown(asset, reconstruct(generator, size))

    def variations(guidance: float) -> dict[str, TexturedMesh]:
        how = Controls(
            invention=options.invention, labels=options.labels, height=options.height, guidance=guidance
        )
        if generator and not options.instant:
            rules = (options.count, options.seed, options.steps, options.sampler, size)
            made = generate(generator, *rules, controls=how, workers=None)
        else:
            guides = run_guides(generator, asset, patches, how) if generator else None
            intact = generator.intact if generator else None
            pieces = patch_generator(asset, patches, 0, how, None, guides, intact)
            made = patchworks(pieces, options.count, options.seed, size, None)
        made = tqdm(made, "variations", options.count, dynamic_ncols=True)
        return {f"sample {n}": shown(asset, painting) for n, painting in enumerate(made)}

    if not samples:
        stage(f"making {options.count} variations" + ", and as many without labels" * (asked is not None))
        samples, unguided = variations(1.0), variations(0.0) if asked else {}
    others |= controls(asset.mesh, options.seed)
    stage(f"judging {len(samples)} samples and {len(others)} controls")
    rows = judge_samples(asset.mesh, samples, others, options.seed)
    if asked:
        free = {f"{name} without labels": mesh for name, mesh in unguided.items()}
        shares = labels_followed(asset.mesh, *asked, {**samples, **free}, options.seed)
        shares["samples"] = float(np.mean([shares[name] for name in samples]))
        rows["without labels"] = {"labels_1": float(np.mean([shares.pop(name) for name in free]))}
        for name, share in shares.items():
            rows[name]["labels_1"] = share
    meshes = {"input": asset.mesh, **samples, **others}
    stage(f"picturing them, to {out}")
    views = [
        [render(mesh, azimuth=a, elevation=e, size=256, up=up) for mesh in meshes.values()] for a, e in VIEWS
    ]
    record = {"source": str(source or "the vase of flx"), **made_by, "rows": rows}
    write_atomically(out / "evaluation.json", (json.dumps(record, indent=2) + "\n").encode())
    sheet = contact_sheet(views, list(meshes))
    write_atomically(
        out / "evaluation.html", page(f"{asset.path.name}: samples judged", sheet, rows).encode()
    )
    return out / "evaluation.html"
