"""Whether labels are followed: what lies at a place is of the label of the input's chart most like it."""

from collections.abc import Mapping

import numpy as np

from flx.evaluation import patches
from flx.evaluation.charts import SHARES, chart_colors, place_charts
from flx.evaluation.samples import BANK, QUERIES
from flx.geometry.geodesics import unfold
from flx.geometry.labels import LabelMap
from flx.types import TexturedMesh


def labels_followed(
    mesh: TexturedMesh,
    own: LabelMap,
    wanted: LabelMap,
    textures: Mapping[str, TexturedMesh],
    seed: int = 0,
) -> dict[str, float]:
    """The share of the surface whose nearest chart of the input has the label that was asked for.

    Charts of 1 % of the area, in every turn; each has the label of its centre.

    Args:
        mesh: The input.
        own: Its labels.
        wanted: Those that were asked for, with the same palette.
        textures: Other textures of the same surface.
        seed: Of the places.

    "input" is the input itself at other places, by its own labels: what can be reached.
    """
    unfolding, rng = unfold(mesh.vertices, mesh.faces), np.random.default_rng([seed, 0, 4])
    places, sites = (place_charts(mesh, unfolding, SHARES[0], n[0], rng) for n in (BANK, QUERIES))
    bank = patches.spectra(patches.describe(chart_colors(mesh, places)))
    labels = own.at(places.centers)

    def share(texture: TexturedMesh, asked: LabelMap) -> float:
        charts = patches.spectra(patches.describe(chart_colors(texture, sites)))
        nearest = patches.distances(charts, bank).argmin(1)
        return float((labels[nearest] == asked.at(sites.centers)).mean())

    return {"input": share(mesh, own), **{name: share(made, wanted) for name, made in textures.items()}}
