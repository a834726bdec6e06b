"""New textures from a trained run: noise, the reverse process, decoded onto the original asset."""

import json
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from flx.assets.asset import Format, Painting
from flx.assets.preflight import check_output
from flx.assets.unwrap import prepared_for
from flx.assets.write import write, write_atlases, write_png
from flx.config import FLDMExperiment
from flx.fields import samplers
from flx.fields.algebra import tangent_noise
from flx.fields.diffusion import latent_scaling
from flx.files import write_atomically
from flx.geometry.seams import seam_ratio
from flx.models.denoiser.vectors import denoise, schedule
from flx.pipeline.canvas import bake, check_size, open_canvas, shown, side_by_side
from flx.pipeline.codec import load_codec
from flx.pipeline.copies import open_cache, prepare
from flx.training.fldm import denoiser, load_copies
from flx.training.loop import restore
from flx.training.run import Run, load_config
from flx.training.run_asset import read_kept

Sampler = Literal["ancestral", "ddim"]


def sample(
    folder: Path,
    count: int = 4,
    seed: int = 0,
    sampler: Sampler = "ddim",
    steps: int = 50,
    texture_size: int | None = None,
    out: Path | None = None,
    format: Format = "glb",
) -> Path:
    """Write `count` variations in a format and as PNG, a contact sheet and samples.json; return their folder.

    Variation n hangs on the seed and n alone: more of them, or a second call, change none. Each file is
    there whole or not at all. Raises ValueError where the folder is not a trained FLDM run.
    """
    check_size(texture_size)
    if count < 1 or steps < 1:
        raise ValueError(f"{count} variations in {steps} steps; give at least one of each")
    experiment = load_config(folder)
    if not isinstance(experiment, FLDMExperiment):
        raise ValueError(f"{folder} is the run of an FL-VAE; sample one of `flx train experiments/demo.py`")
    run, surface = Run(folder), experiment.surface
    asset, out = read_kept(run, surface), out or run.samples
    files = [out / f"variation_{n:02d}.{format}" for n in range(count)]
    check_output(asset, format, files, [out / "contact_sheet.png"])
    codec = load_codec(experiment.weights)
    cache = open_cache(run.prepared, asset, surface, codec)
    prepare(cache, asset, surface, codec)
    copies = load_copies(cache, experiment)
    latents = np.concatenate([copy.latents for copy in copies])
    scaling, home = latent_scaling(latents, codec.config.invariants), copies[0]
    network = denoiser(experiment, codec)
    model = network.config
    state = restore(run, experiment.train, abstract_params(network, home.tables, model.latents))
    alphas = schedule(model)
    table = samplers.ddim_steps(alphas, steps) if sampler == "ddim" else samplers.ancestral_steps(alphas)

    @jax.jit
    def draw(params: Any, tables: Any, key: jax.Array) -> jax.Array:
        of_start, of_steps = jax.random.split(key)
        start = tangent_noise(of_start, (len(home.latents), model.latents))
        return samplers.reverse(lambda z, t: denoise(network, params, tables, z, t), table, start, of_steps)

    asset = prepared_for(asset, format)
    canvas = open_canvas(asset, home.triangulation, texture_size)
    variations: list[Painting] = []
    for n in tqdm(range(count), desc="variations", unit="texture", dynamic_ncols=True):
        key = jax.random.fold_in(jax.random.key(seed), n)
        z = np.asarray(draw(state.ema, home.tables, key))
        baked = bake(canvas, codec, scaling.to_latents(z))
        write(asset, baked, files[n])
        write_atlases(asset, baked, files[n])
        variations.append(baked)
    names = [f"variation {n:02d}" for n in range(count)]
    write_png(out / "contact_sheet.png", side_by_side(asset, variations[:8], names[:8], surface.up))
    record = {
        "run": str(folder),
        "step": int(state.step),
        "seed": seed,
        "sampler": sampler,
        "steps": len(table.t),
        "vertices": surface.vertices,
        "seam_ratios": [seam_ratio(shown(asset, baked)) for baked in variations],
        "seam_ratio_input": seam_ratio(asset.mesh),
        "files": [file.name for file in files],
    }
    write_atomically(out / "samples.json", (json.dumps(record, indent=2) + "\n").encode())
    return out


def abstract_params(network: Any, tables: Any, latents: int) -> Any:
    """The shapes of the network's parameters."""
    z = jnp.zeros((len(tables.fine.masses), latents), jnp.complex64)
    return jax.eval_shape(network.init, jax.random.key(0), tables, z, jnp.float32(1))
