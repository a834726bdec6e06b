"""What the judge of samples found, as one HTML page with its pictures inside."""

import base64
import io
from collections.abc import Mapping
from html import escape
from string import Template
from typing import Any

from jaxtyping import UInt8
from PIL import Image

EXPLAINED = {
    "swd_vgg16": "VGG16 features: sliced Wasserstein distance to the input (lower is better)",
    "swd": "chart descriptions: sliced Wasserstein distance to the input (lower is better)",
    "nearest": "mean distance of a chart to the nearest one of the input, in 1/255 (lower is better)",
    "coverage": "share of the input's charts that were made (higher is better)",
    "labels": "share of the surface that is most like a chart of the input with the label that was asked for "
    "(higher is better; without labels: what is right by chance)",
    "copied": "share of charts copied from the same place of the input (lower is better)",
}
BAR, WIDTH = 15, 260  # pixels: height of a bar, length of the longest
PAGE = Template("""<!doctype html><html lang="en"><meta charset="utf-8"><title>$title</title>
<style>body{font:14px system-ui,sans-serif;margin:2em;max-width:90em}img{max-width:100%}
section{display:flex;flex-wrap:wrap;gap:2em}h3{font-size:1em}td,th{padding:.1em .7em;text-align:right}</style>
<h1>$title</h1>
<p>Charts of 1, 5 and 20 % of the surface at random places in random turns. The row <i>input</i> is
the input itself at other places: the floor of each distance, and what a copy looks like.</p>
<img alt="the input, the samples and the controls from two sides" src="data:image/jpeg;base64,$picture">
$plots<h2>All numbers</h2><table>$table</table></html>
""")


def page(title: str, picture: UInt8[Any, "_ _ 3"], rows: Mapping[str, Mapping[str, float]]) -> str:
    """The page; `rows` are those of `flx.evaluation.samples.judge_samples`."""
    content = io.BytesIO()
    Image.fromarray(picture).save(content, "JPEG", quality=88)
    metrics = list(dict.fromkeys(name for row in rows.values() for name in row))
    plots = []
    for family, meaning in EXPLAINED.items():
        names = [name for name in metrics if name.rpartition("_")[0] == family]
        bars = "".join(_bars(f"{name.rpartition('_')[2]} % charts", name, rows) for name in names)
        plots.append(f"<h2>{escape(meaning)}</h2><section>{bars}</section>" if bars else "")
    lines = [["", *metrics]]
    lines += [[name, *(f"{row[m]:.3f}" if m in row else "" for m in metrics)] for name, row in rows.items()]
    table = "".join("<tr>" + "".join(f"<td>{escape(cell)}" for cell in line) for line in lines)
    encoded = base64.b64encode(content.getvalue()).decode()
    return PAGE.substitute(title=escape(title), picture=encoded, plots="".join(plots), table=table)


def _bars(caption: str, metric: str, rows: Mapping[str, Mapping[str, float]]) -> str:
    values = {name: row[metric] for name, row in rows.items() if metric in row}
    longest = max([1e-9, *values.values()])
    bars = []
    for n, (name, value) in enumerate(values.items()):
        y, length = n * (BAR + 4), WIDTH * value / longest
        bars.append(
            f'<rect x="90" y="{y}" width="{length:.1f}" height="{BAR}" fill="#4a78b8"/>'
            f'<text x="84" y="{y + 12}" text-anchor="end">{escape(name)}</text>'
            f'<text x="{length + 94:.1f}" y="{y + 12}">{value:.3f}</text>'
        )
    size = f'width="{WIDTH + 150}" height="{len(values) * (BAR + 4)}"'
    return f'<div><h3>{caption}</h3><svg {size} font-size="12">{"".join(bars)}</svg></div>'
