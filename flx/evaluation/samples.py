"""The judge of samples: how faithful new textures are to their input, how varied, and how much they copy.

Charts of 1, 5 and 20 % of the area are taken at random places, in random turns, from the input and from each
new texture. The input itself at other places is the floor of each number, and shows what a copy looks like;
`flx.evaluation.controls` makes more rows to compare with.
"""

import sys
from collections.abc import Iterable, Mapping
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32
from tqdm import tqdm

from flx.evaluation import patches
from flx.evaluation.charts import SHARES, Charts, Sites, chart_colors, chart_images, place_charts
from flx.evaluation.lpips import Judge, installed_judges
from flx.geometry import render
from flx.geometry.geodesics import Unfolding, unfold
from flx.types import TexturedMesh

BANK = (1500, 1000, 400)  # charts of the input of each size
QUERIES = (400, 300, 200)  # of each new texture
SEEN = 160  # of those, charts that VGG16 sees
DEPTHS = 3  # of VGG16 whose features are compared
VIEWS = ((0.0, 15.0), (90.0, 15.0), (180.0, 15.0), (270.0, 15.0))  # azimuth, elevation: for LPIPS
HINT = "swd_vgg16 and the LPIPS of samples need the extra: pip install '.[eval]' in the clone"

Row = dict[str, float]


class _Reference(NamedTuple):
    """The input's charts of one size, as textures are compared with them."""

    sites: Sites  # where textures on the input's surface are looked at
    bank: patches.Spectra
    own: patches.Described  # of the input at `sites`
    between: Float32[Any, "M N"]  # from each chart of the bank to those
    described: Float32[Any, "M C"]
    features: list[Float32[Any, "P C"]]


def judge_samples(
    mesh: TexturedMesh,
    samples: Mapping[str, TexturedMesh],
    others: Mapping[str, TexturedMesh] | None = None,
    seed: int = 0,
) -> dict[str, Row]:
    """A row of numbers for each sample, for the input and for each of `others`; "samples" is the mean.

    For each chart size s (1, 5, 20): `swd_vgg16_s`, the sliced Wasserstein distance of VGG16's features, in
    standard deviations (with the extra `eval`); `swd_s`, the same of the charts' descriptions; `nearest_s`,
    the mean distance of a chart to the input's nearest in 1/255; `coverage_s`, the share of the input's
    charts that were made; `copied_s`, the share of charts taken from the same place of the input unturned
    (not for another surface). For the mean also `diversity`: the distance of two samples at the same place as
    a share of that of two places of the input, and `lpips_alex` between samples in the same views.
    Deterministic for a seed. Raises ValueError without samples.
    """
    if not samples:
        raise ValueError("there is no sample to judge; give at least one")
    judges = installed_judges()
    if not judges:
        print(f"flx: {HINT}", file=sys.stderr)
    vgg = next((judge for judge in judges if judge.metric == "lpips_vgg"), None)
    unfolding = unfold(mesh.vertices, mesh.faces)
    references = {share: _reference(mesh, unfolding, k, vgg, seed) for k, share in enumerate(SHARES)}
    rows: dict[str, Row] = {}
    every = {**samples, "input": mesh, **(others or {})}
    described: dict[str, list[Any]] = {}
    for name, texture in tqdm(every.items(), "judged", unit="mesh", dynamic_ncols=True):
        same = texture.faces.shape == mesh.faces.shape and np.allclose(texture.vertices, mesh.vertices)
        theirs = None if same else unfold(texture.vertices, texture.faces)
        rows[name] = {}
        for k, (share, reference) in enumerate(references.items()):
            sites = reference.sites
            if theirs is not None:
                sites = place_charts(texture, theirs, share, QUERIES[k], np.random.default_rng([seed, k, 2]))
            charts = chart_colors(texture, sites)
            chart_descriptions = patches.describe(charts)
            rng = np.random.default_rng([seed, k, 3])
            row = _compare(reference, charts, chart_descriptions, same, vgg, rng)
            rows[name] |= {f"{metric}_{round(share * 100)}": value for metric, value in row.items()}
            if name in samples and same:
                described.setdefault(name, []).append(chart_descriptions)
    shared = [m for m in rows["input"] if all(m in rows[name] for name in samples)]
    mean = {metric: float(np.mean([rows[name][metric] for name in samples])) for metric in shared}
    if len(described) > 1:
        mean["diversity"] = _diversity(list(described.values()), references)
    if len(samples) > 1 and (alex := next((j for j in judges if j.metric == "lpips_alex"), None)):
        mean["lpips_alex"] = _lpips_between(list(samples.values()), alex)
    return {"samples": mean, **rows}


def _reference(
    mesh: TexturedMesh, unfolding: Unfolding, size: int, vgg: Judge | None, seed: int
) -> _Reference:
    share = SHARES[size]
    bank = chart_colors(
        mesh, place_charts(mesh, unfolding, share, BANK[size], np.random.default_rng([seed, size, 0]))
    )
    sites = place_charts(mesh, unfolding, share, QUERIES[size], np.random.default_rng([seed, size, 1]))
    own, described = patches.describe(chart_colors(mesh, sites)), patches.describe(bank)
    spectra = patches.spectra(described)
    between = patches.distances(spectra, patches.spectra(own))
    flat = described.reshape(len(described), -1)
    return _Reference(sites, spectra, own, between, flat, _features(bank, vgg))


def _features(charts: Charts, vgg: Judge | None) -> list[Float32[Any, "P C"]]:
    return vgg.features(chart_images(charts[:SEEN]), DEPTHS) if vgg else []


def _compare(
    reference: _Reference,
    charts: Charts,
    described: patches.Described,
    same: bool,
    vgg: Judge | None,
    rng: np.random.Generator,
) -> Row:
    row = {}
    if vgg:
        depths = zip(_features(charts, vgg), reference.features, strict=True)
        row["swd_vgg16"] = float(np.mean([patches.sliced_wasserstein(a, b, rng) for a, b in depths]))
    flat = described.reshape(len(described), -1)
    row["swd"] = patches.sliced_wasserstein(flat, reference.described, rng)
    spectra = patches.spectra(described)
    between = patches.distances(spectra, reference.bank)
    row["nearest"] = float(between.min(1).mean())
    row["coverage"] = patches.coverage(reference.between, between.T)
    if same:
        row["copied"] = float(patches.copied(described, reference.own, between).mean())
    return row


def _diversity(described: list[list[Any]], references: Mapping[float, _Reference]) -> float:
    """1 where two samples differ at a place as much as two places of the input do."""
    ratios = []
    for k, reference in enumerate(references.values()):
        pairs = [a[k] - b[k] for a, b in combinations(described, 2)]
        places = reference.own - np.roll(reference.own, 1, axis=0)
        ratios.append(np.mean([_length(pair) for pair in pairs]) / max(_length(places), 1e-6))
    return float(np.mean(ratios))


def _length(difference: patches.Described) -> float:
    return float(np.sqrt(np.einsum("nbav,nbav->n", difference, difference)).mean())


def _lpips_between(meshes: Iterable[TexturedMesh], alex: Judge, size: int = 256) -> float:
    values = []
    for first, second in combinations(meshes, 2):
        for azimuth, elevation in VIEWS:
            view = render.look(first, azimuth, elevation, size)
            covered = np.zeros((size * view.supersample) ** 2, bool)
            covered[view.rays] = True
            blocks = covered.reshape(size, view.supersample, size, view.supersample)
            pictures = (render.show(view, mesh) for mesh in (first, second))
            values.append(alex.distance(next(pictures), next(pictures), blocks.all((1, 3))))
    return float(np.mean(values))
