"""Charts of a new texture against charts of the texture that it was learnt from, in every turn.

A chart is described by the mean and the spread of colours in cells a quarter of its radius wide: what lies
where, and how much detail, tolerant of a shift by half a cell. Distances are root mean square differences in
steps of 1/255. The spread counts twice; without it a blurred texture is nearest of all.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32

from flx.evaluation.charts import ANGLES, RINGS, Charts

BANDS = 4  # rings of a description
SPREAD = 2.0  # weight of the spread
ROWS = 64  # charts compared with all others at a time

Described = Float32[Any, "N 4 32 6"]  # band, angle, mean and spread of three colours


class Spectra(NamedTuple):
    """Descriptions as Fourier series over their angles: all turns of two charts are compared at once."""

    series: Any  # complex64 [frequency, N, band and value]
    powers: Float32[Any, "N"]


def describe(charts: Charts) -> Described:
    """Scaled so that the sum of squared differences is the mean over the chart's area, in (1/255)²."""
    mean = _smooth(charts)
    spread = np.sqrt(np.maximum(_smooth(charts**2) - mean**2, 0))
    shares = np.diff((np.arange(BANDS + 1) / BANDS) ** 2) / ANGLES
    weights = 255 * np.sqrt(shares / 3).astype(np.float32)[:, None, None]
    return np.concatenate([mean, SPREAD * spread], -1) * weights


def _smooth(values: Float32[Any, "N 12 32 C"]) -> Float32[Any, "N 4 32 C"]:
    """Means over bands of rings, and over windows of angles that are as wide as a band."""
    areas = (np.arange(RINGS) + 0.5).reshape(BANDS, -1)
    areas /= areas.sum(1, keepdims=True)
    banded = values.reshape(len(values), BANDS, -1, ANGLES, values.shape[-1])
    series = np.fft.rfft(np.einsum("nbrac,br->nbac", banded, areas.astype(np.float32)), axis=2)
    widths = 1 / (np.arange(BANDS) + 0.5)  # radians
    windows = np.sinc(np.arange(series.shape[2]) * widths[:, None] / (2 * np.pi))
    return np.fft.irfft(series * windows[None, :, :, None], ANGLES, axis=2).astype(np.float32)


def spectra(described: Described) -> Spectra:
    """The Fourier series of descriptions, for `distances`."""
    series = np.fft.rfft(described, axis=2).transpose(2, 0, 1, 3)
    powers = np.einsum("nbav,nbav->n", described, described)
    return Spectra(np.ascontiguousarray(series.reshape(*series.shape[:2], -1)), powers)


def distances(queries: Spectra, bank: Spectra) -> Float32[Any, "N M"]:
    """The distance of each query from each chart of the bank, in the turn in which it is least."""
    result = np.empty((len(queries.powers), len(bank.powers)), np.float32)
    backwards = bank.series.conj().transpose(0, 2, 1)
    for start in range(0, len(result), ROWS):
        rows = slice(start, start + ROWS)
        products = (queries.series[:, rows] @ backwards).transpose(1, 2, 0)
        best = np.fft.irfft(np.ascontiguousarray(products), ANGLES, axis=2).max(2)
        result[rows] = np.sqrt(np.maximum(queries.powers[rows, None] + bank.powers - 2 * best, 0))
    return result


def coverage(own: Float32[Any, "N M"], new: Float32[Any, "N K"]) -> float:
    """The share of the input's charts that the new texture has, too (Naeem et al. 2020).

    That is: one of its charts is as near as the third nearest other chart of the input. Rows are charts of
    the input, columns other charts of the input (`own`) and as many of the new texture.
    """
    return float((new.min(1) <= np.partition(own, 2, 1)[:, 2]).mean())


def copied(new: Described, old: Described, others: Float32[Any, "N M"]) -> Bool[Any, "N"]:
    """Whether a chart's nearest chart of the input is at the same place, turned by at most one angle.

    `old` are the input's charts at the same places, `others` the distances from the rest of its charts.
    """
    turned = [np.roll(old, turn, axis=2) - new for turn in (-1, 0, 1)]
    here = np.sqrt(np.min([np.einsum("nbav,nbav->n", d, d) for d in turned], 0))
    return here < others.min(1)


def sliced_wasserstein(
    a: Float[Any, "N C"], b: Float[Any, "M C"], rng: np.random.Generator, slices: int = 64
) -> float:
    """The mean distance of two distributions along random lines, in standard deviations of `b`."""
    lines = rng.normal(size=(a.shape[1], slices)).astype(np.float32)
    lines /= np.linalg.norm(lines, axis=0)
    first, second = (quantiles(x @ lines, 512) for x in (a, b))
    return float(np.abs(first - second).mean() / max(second.std(axis=0).mean(), 1e-6))


def quantiles(values: Float[Any, "N S"], count: int) -> Float[Any, "Q S"]:
    """As many evenly spaced quantiles of each column, linearly interpolated.

    Those of `np.quantile`, which takes several times as long for so many.
    """
    ordered = np.sort(values, axis=0)
    places = (np.arange(count) + 0.5) / count * (len(values) - 1)
    below = places.astype(int)
    above, share = np.minimum(below + 1, len(values) - 1), (places - below)[:, None].astype(values.dtype)
    return ordered[below] + share * (ordered[above] - ordered[below])
