"""The viewer: one HTML file with an asset and paintings of it, which needs no network and no other file.

`shot` makes each painting small when it is there, so that large textures need not be held; `page` puts all of
them into the bytes that an e-mail may have.
"""

import base64
import hashlib
import json
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import PurePath
from string import Template
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import UInt8

from flx.assets.asset import Asset, Painting, own_painting
from flx.geometry.color import quantized
from flx.viewer.pictures import RUNGS, alpha_png, fitted, master
from flx.viewer.surface import Surface, packed, surface

LIMIT = 15_000_000  # bytes of a page: mail servers take attachments of 20 MB and more
NAME = "viewer.html"
STYLES, LIBRARIES, SCRIPTS = ("page.css",), ("three.min.js",), ("camera.js", "page.js")


class Shot(NamedTuple):
    """A painting, as small as a page needs it."""

    name: str
    asset: Asset
    images: tuple[bytes, ...]  # JPEG, one for each texture
    colors: UInt8[Any, "V 3"]  # of the original vertices; none where there are images
    file: str  # the name of the mesh file beside the page; "" for none


def shot(name: str, asset: Asset, painting: Painting | None = None, file: str = "") -> Shot:
    """A painting of an asset for the page; without one, the asset as it is."""
    painting = own_painting(asset) if painting is None else painting
    if not asset.textures:
        return Shot(name, asset, (), quantized(painting.colors), file)
    images = painting.images or asset.mesh.textures
    return Shot(name, asset, tuple(map(master, images)), np.zeros((0, 3), np.uint8), file)


def page(
    title: str,
    shots: Sequence[Shot],
    settings: Mapping[str, Any],
    up: Literal["y", "z"] = "y",
    limit: int = LIMIT,
) -> bytes:
    """The page, of at most `limit` bytes. The first shot is the input; the same input gives the same bytes.

    Settings that are None or False are not shown. Textures are at most 1024 pixels, smaller and of lower
    quality where there are many. Paintings that do not fit even so are left out, from the last one; the page
    says both.

    Raises ValueError where the mesh alone is too large.
    """
    assets = {id(one.asset): one.asset for one in shots}
    surfaces = {key: surface(asset) for key, asset in assets.items()}
    alphas = {key: _alphas(asset, surfaces[key]) for key, asset in assets.items()}
    place = {key: number for number, key in enumerate(assets)}
    data: dict[str, Any] = {
        "up": up,
        "meshes": [{**surfaces[key].data, "alphas": alphas[key]} for key in assets],
        "settings": [
            [name, _word(it)] for name, it in settings.items() if it is not None and it is not False
        ],
    }
    count, least = len(shots), min(2, len(shots))
    while count >= least:
        some = shots[:count]
        data["paintings"] = [_entry(one, place[id(one.asset)], surfaces[id(one.asset)]) for one in some]
        data |= {"pictures": [], "notes": _notes(some, *RUNGS[0], len(shots))}
        # In base64 three bytes are four; some more name each image.
        names = 60 * sum(len(one.images) for one in some) + 500
        room = (limit - len(_html(title, data)) - names) * 3 // 4
        if room > 0 and (fit := fitted([one.images for one in some], room)):
            numbers: dict[bytes, int] = {}
            for entry, images in zip(data["paintings"], fit.images, strict=True):
                entry["pictures"] = [numbers.setdefault(image, len(numbers)) for image in images]
            data["pictures"] = [url("jpeg", image) for image in numbers]
            data["notes"] = _notes(some, fit.longest, fit.quality, len(shots))
            return _html(title, data)
        count -= max(1, count // 4)
    faces = ", ".join(f"{asset.report.faces:,}" for asset in assets.values())
    raise ValueError(f"{faces} faces are too many for a page of {limit / 1e6:.0f} MB; open the files instead")


def _entry(one: Shot, mesh: int, surface: Surface) -> dict[str, Any]:
    """A painting as the page reads it; its pictures are still to come."""
    colors = None if one.images else packed(one.colors[surface.vertices])
    return {"name": one.name, "file": one.file, "mesh": mesh, "colors": colors, "pictures": []}


def _notes(shots: Sequence[Shot], longest: int, quality: int, wanted: int) -> list[str]:
    """What of the files the page does not show, in sentences."""
    notes = []
    if any(one.images for one in shots):
        smaller = f"at most {longest} pixels on the longer side, as JPEG of quality {quality}"
        notes.append(
            f"Textures on this page: {smaller}, so that it can be e-mailed. The files hold them whole."
        )
        notes.append("Base colours are shown, in the light of flx's own pictures; other maps are not.")
    if len(shots) < wanted:
        notes.append(f"{len(shots) - 1} of {wanted - 1} paintings fit on this page; all are in the folder.")
    return notes


def _alphas(asset: Asset, surface: Surface) -> list[str | None]:
    """The alpha of each texture, where a material uses it."""
    used = {group["image"] for group in surface.data["groups"] if group["alpha_mode"] != "OPAQUE"}
    alphas = [texture.alpha if n in used else None for n, texture in enumerate(asset.textures)]
    return [None if alpha is None else url("png", alpha_png(alpha)) for alpha in alphas]


def _html(title: str, data: Mapping[str, Any]) -> bytes:
    return html("page.html", STYLES, LIBRARIES, SCRIPTS, title=title, data=data)


def html(
    name: str,
    styles: Sequence[str],
    libraries: Sequence[str],
    scripts: Sequence[str],
    title: str,
    data: Mapping[str, Any],
    served: bool = False,
) -> bytes:
    """A page with its styles, libraries, own scripts (as one) and data inside it; by their hashes these are
    the only scripts that may run. Only a page that is `served` may ask its server."""
    names = ("frame.html", name, *styles, *libraries, *scripts)
    read = {one: (files("flx.viewer") / one).read_text("utf-8") for one in names}
    running = [*(read[one] for one in libraries), "".join(read[one] for one in scripts)]
    hashes = (_base64(hashlib.sha256(script.encode()).digest()) for script in running)
    # In a script element only "<" could end it, or begin a comment.
    text = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    filled = Template(read["frame.html"]).substitute(
        title=escape(title),
        connections=" connect-src 'self';" if served else "",
        body=Template(read[name]).substitute(title=escape(title)),
        hashes=" ".join(f"'sha256-{one}'" for one in hashes),
        style="".join(read[style] for style in styles),
        scripts="\n".join(f"<script>{script}</script>" for script in running),
        data=text,
    )
    return filled.encode("utf-8", "replace")  # a name may be of no text


def url(kind: str, content: bytes) -> str:
    return f"data:image/{kind};base64,{_base64(content)}"


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode()


def _word(value: Any) -> str:
    """A setting in words. Folders are left out: the page may go to others."""
    return (isinstance(value, str | PurePath) and PurePath(value).name) or str(value)
