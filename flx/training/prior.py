"""Train a diffusion model on planar pieces of many images: a prior, which knows what textures are made of.

A training on one mesh may begin with it (`flx.training.start`), and has to learn only what is its mesh's own.
A piece is a planar mesh laid on an image at random; its codes are scaled by its own statistics, as those of a
mesh are.
"""

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex64, Int
from tqdm import tqdm

from flx.config import Images, PriorExperiment, Sheets
from flx.fields.diffusion import Scaling, emphasized, latent_scaling
from flx.files import write_atomically
from flx.geometry.copies import points_in_rings
from flx.geometry.remesh.planar import planar
from flx.geometry.remesh.remesh import remesh
from flx.geometry.sampling import positions
from flx.geometry.tables import mesh_tables, stack
from flx.geometry.tangent import tangent_frames
from flx.models.denoiser.depth import complete
from flx.pipeline.codec import Codec, load_codec
from flx.pipeline.generator import network_of
from flx.pipeline.patches import IMAGE_SIDE, colors_at, load_images, random_placement
from flx.pipeline.printed_pages import printed_pages
from flx.stopping import keeping
from flx.training.fldm import MeshBatch, diffusion_loss, draw_times
from flx.training.loop import kept, train
from flx.training.run import Run, open_run
from flx.training.start import begun, check_start, save_prior
from flx.types import MeshTables, RingSamples

FLAT = 0.03  # standard deviation of colours below which a piece has nothing to teach


class Sheet(NamedTuple):
    """A planar mesh, and points in its one-rings."""

    tables: MeshTables
    logs: Complex64[np.ndarray, "V S"]
    places: Complex64[np.ndarray, "V S"]  # in the plane, in mean vertex radii, around the middle


class Pieces(NamedTuple):
    """Codes of planar meshes on images."""

    sheet: Int[np.ndarray, "P"]  # which mesh
    latents: Complex64[np.ndarray, "P V D"]


def learn_prior(experiment: PriorExperiment, root: Path) -> Run:
    """Make the pieces (cached), then train on them; the run folder gets `prior.safetensors` at checkpoints.

    Raises ValueError where the folder of images has none, or the network does not fit the FL-VAE.
    """
    config, codec = experiment.train, load_codec(experiment.weights)
    model = complete(experiment.model, codec.config, experiment.sheets.vertices)
    experiment, network = replace(experiment, model=model), network_of(model)
    before = check_start(experiment.start, model, codec)
    photos = load_images(Path(experiment.images.folder))
    prints = printed_pages(round(experiment.images.prints * len(photos)), IMAGE_SIDE, experiment.images.seed)
    images = np.concatenate([photos, prints])
    digest = hashlib.sha256(images.tobytes() + codec.digest().encode()).hexdigest()
    run = open_run(root, experiment, digest)
    keeping(lambda: kept(run))
    sheets = make_sheets(experiment.sheets, codec.config.samples)
    made = run.prepared / "pieces.npz"
    pieces = prepared_pieces(made, experiment.sheets, experiment.images, sheets, images, codec)
    scaled = scaled_pieces(pieces.latents, codec, model.emphasis)
    tables = stack([sheet.tables for sheet in sheets])

    def batches(step: int) -> MeshBatch:
        chosen = np.random.default_rng([config.seed, step]).integers(0, len(scaled), config.batch)
        seen = jax.tree.map(lambda a: a[pieces.sheet[chosen]], tables)
        return MeshBatch(
            seen, scaled[chosen], draw_times(model, config.seed, step * config.batch, config.batch)
        )

    def save(step: int, params: Any) -> None:
        save_prior(run.folder / "prior.safetensors", model, params, codec, step, len(images))

    params = jax.jit(network.init)(jax.random.key(config.seed), sheets[0].tables, scaled[0], jnp.float32(1))
    if before:
        params = begun(before, params)
    state = train(run, config, params, diffusion_loss(model, network), batches, save)
    save(int(state.step), state.ema)
    return run


def make_sheets(config: Sheets, samples: int) -> list[Sheet]:
    """Square planar meshes, made as the copies of a surface are."""
    rng, sheets = np.random.default_rng(config.seed), []
    square = planar(config.vertices, (1.0, 1.0), rng)
    for n in range(config.meshes):
        mesh = remesh(square.vertices, square.faces, config.vertices, config.seed + n)
        points, logs = points_in_rings(mesh, samples, rng)
        x, y, _ = (positions(mesh.vertices, mesh.faces, points) - 0.5).T / tangent_frames(mesh).radius
        places = (x + 1j * y).reshape(logs.shape).astype(np.complex64)
        sheets.append(Sheet(mesh_tables(mesh), logs, places))
    return sheets


def prepared_pieces(
    path: Path, config: Sheets, images_config: Images, sheets: list[Sheet], images: Any, codec: Codec
) -> Pieces:
    """`encode_pieces`, kept in a file."""
    if not path.exists():
        pieces = encode_pieces(config, images_config, sheets, images, codec)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, lambda torn: np.savez(torn, **pieces._asdict()))
    with np.load(path, allow_pickle=False) as file:
        return Pieces(file["sheet"], file["latents"])


def encode_pieces(
    config: Sheets, images_config: Images, sheets: list[Sheet], images: Any, codec: Codec
) -> Pieces:
    """Pieces of images, placed at random, on the meshes by turns; those of one flat colour are left out."""
    images, key, kept = jnp.asarray(images), jax.random.key(config.seed), []
    with tqdm(total=config.pieces, desc="pieces", unit="piece", dynamic_ncols=True) as bar:
        for n in range(10 * config.pieces):
            sheet = n % len(sheets)
            placement = random_placement(jax.random.fold_in(key, n), 1, len(images), images_config)
            colors = colors_at(images, placement, jnp.asarray(sheets[sheet].places[None]))[0][0]
            if float(jnp.std(colors, axis=(0, 1)).mean()) < FLAT:
                continue
            kept.append((sheet, codec.encode(RingSamples(sheets[sheet].logs, np.asarray(colors)))))
            bar.update()
            if len(kept) == config.pieces:
                break
    if not kept:
        raise ValueError("every image is of one flat colour; name another --images.folder")
    return Pieces(np.array([sheet for sheet, _ in kept]), np.stack([latents for _, latents in kept]))


def scaled_pieces(
    latents: Complex64[np.ndarray, "P V D"], codec: Codec, emphasis: float
) -> Complex64[np.ndarray, "P V D"]:
    """Each piece scaled by its own statistics, its channels emphasized by what they show, as of a mesh."""
    invariants = codec.config.invariants
    pool = latents.reshape(-1, latents.shape[-1])
    common = latent_scaling(pool, invariants)
    effects = codec.effects(pool, common)
    scaled = np.empty_like(latents)
    for n, piece in enumerate(latents):
        scaling = latent_scaling(piece, invariants)
        if emphasis:
            scaling = emphasized(scaling, rescaled(effects, common, scaling), emphasis, invariants)
        scaled[n] = scaling.to_diffusion(piece)
    return scaled


def rescaled(effects: Any, common: Scaling, own: Scaling) -> Complex64[np.ndarray, "D"]:
    """The effects of one unit of each channel, where a unit is that of another scaling."""
    re, im = (part(effects) * part(common.scale) / part(own.scale) for part in (np.real, np.imag))
    return (re + 1j * im).astype(np.complex64)
