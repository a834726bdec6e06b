"""Train a field-latent VAE on patches of images."""

from pathlib import Path
from typing import Any

from jax import Array

from flx.config import FLVAEExperiment
from flx.models.codec import frame
from flx.models.codec.vae import FieldLatentVAE, flvae_loss
from flx.pipeline.codec import Codec, initial_params, save_codec
from flx.pipeline.patches import PATCH_VERTICES, ImagePatches, PatchBatch, first_rings
from flx.stopping import keeping
from flx.training.loop import LossFn, averaged, kept, train
from flx.training.run import Run, open_run


def learn_flvae(experiment: FLVAEExperiment, root: Path) -> Run:
    """Train a field-latent VAE on a folder of images; the run folder gets `flvae.safetensors`."""
    config = experiment.train
    patches = ImagePatches(experiment.images, experiment.model, config.batch)
    run = open_run(root, experiment, patches.digest)
    keeping(lambda: kept(run))
    params = starting_params(experiment, patches)
    state = train(run, config, params, image_loss(experiment), patches)
    rings = config.steps * config.batch * PATCH_VERTICES
    card = {"steps": config.steps, "rings": rings, "images": len(patches.images)}
    card = {name: str(value) for name, value in {**card, "kl_weight": experiment.kl_weight}.items()}
    save_codec(run.folder / "flvae.safetensors", Codec(experiment.model, averaged(state, params)), card)
    return run


def image_loss(experiment: FLVAEExperiment) -> LossFn:
    """The loss on the colours at a batch's points: of the blend there, or of each corner's prediction."""
    model = FieldLatentVAE(experiment.model)

    def loss(params: Any, batch: PatchBatch, key: Array) -> tuple[Array, dict[str, Array]]:
        answer: Any = model.apply(params, batch.rings, batch.queries, key)
        blended, corners, posterior = answer
        if experiment.learns == "blend":
            return flvae_loss(batch.colors, blended, posterior, experiment.kl_weight)
        return flvae_loss(batch.colors[:, None], corners, posterior, experiment.kl_weight)

    return loss


def starting_params(experiment: FLVAEExperiment, patches: ImagePatches) -> Any:
    """Random parameters; those of the frame codec start from the principal components of real rings."""
    params = initial_params(experiment.model, experiment.train.seed)
    if experiment.model.encoder != "frame":
        return params
    # Batches that no step of the training sees.
    return frame.start_from_principal_components(params, first_rings(patches, experiment.train.steps))
