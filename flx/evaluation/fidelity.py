"""How close one texture is to another: metrics in the atlas, over the texels that show the surface."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, UInt8
from skimage.metrics import structural_similarity

from flx.assets.asset import Asset, Painting, check_asset, check_painting, own_painting
from flx.evaluation.lpips import Judge
from flx.geometry.atlas import Atlas, fill_gutter
from flx.geometry.color import resized
from flx.pipeline.canvas import atlases_of

WINDOW = 11  # side of DSSIM's Gaussian windows in pixels; smaller images are padded to it


def fidelity(
    asset: Asset,
    painting: Painting,
    judges: Sequence[Judge] = (),
    atlases: Sequence[Atlas | None] | None = None,
) -> dict[str, float]:
    """PSNR, DSSIM and LPIPS of new textures against the asset's own, over the texels that show the surface.

    Args:
        asset: The mesh file whose textures are the reference.
        painting: New textures of it, [H, W, 3] each, from `flx.paint`; of another size, they are compared at
            theirs. Or new colours at its vertices, [V, 3]: they get a PSNR only, over the vertices.
        judges: Networks for LPIPS, from `flx.evaluation.lpips.installed_judges`.
        atlases: The texels of each texture, if the caller has them already.

    Raises ValueError where the asset and the painting do not have equally many textures.

    Example:
        painting = flx.paint(asset, copy, codec, codec.encode(copy.rings))
        flx.fidelity(asset, painting)["psnr"]  # in dB
    """
    check_asset("asset", asset)
    check_painting("painting", painting)
    if not painting.images:
        used = np.unique(asset.corner_vertices)
        own = own_painting(asset).colors
        return {"psnr": psnr(float(np.mean((own[used] - painting.colors[used]) ** 2)))}
    atlases = atlases or atlases_of(asset, [image.shape[:2] for image in painting.images])
    distances, weights = [], []
    for atlas, own, new in zip(atlases, asset.mesh.textures, painting.images, strict=True):
        if atlas is None or not atlas.covered.any():
            continue
        distances.append(compare(resized(own, *new.shape[:2]), new, atlas.covered, judges))
        weights.append(atlas.covered.sum())
    means = {name: float(np.average([d[name] for d in distances], weights=weights)) for name in distances[0]}
    return {"psnr": psnr(means.pop("squared_error")), **means}


def compare(
    own: UInt8[Any, "H W 3"],
    new: UInt8[Any, "H W 3"],
    covered: Bool[Any, "H W"],
    judges: Sequence[Judge] = (),
) -> dict[str, float]:
    """Mean squared error in [0, 1], DSSIM = (1 − SSIM)/2 and LPIPS over the covered texels.

    SSIM as Wang et al.: Gaussian windows of σ = 1.5. Both images get the same gutters, so that a window at
    the rim of a chart compares colours of the surface alone.
    """
    own, new = fill_gutter(own, covered), fill_gutter(new, covered)
    missing = [(0, max(0, WINDOW - side)) for side in covered.shape]
    covered = np.pad(covered, missing)
    own, new = (np.pad(image, [*missing, (0, 0)], mode="edge") for image in (own, new))
    ours, theirs = (image.astype(np.float32) / 255 for image in (own, new))
    similarity = structural_similarity(
        ours,
        theirs,
        data_range=1.0,
        channel_axis=-1,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )[1]
    return {
        "squared_error": float(np.mean((ours - theirs)[covered] ** 2)),
        "dssim": float((1 - np.asarray(similarity)[covered].mean()) / 2),
        **{judge.metric: judge.distance(own, new, covered) for judge in judges},
    }


def psnr(mean_squared_error: float) -> float:
    """−10 log₁₀ of the mean squared error of colours in [0, 1], in dB."""
    return float(-10 * np.log10(max(mean_squared_error, 1e-12)))
