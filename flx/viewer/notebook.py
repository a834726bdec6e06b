"""The viewer in a notebook: the same page, in a frame. No notebook library is loaded."""

from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Literal

from flx.arguments import check_word, path_of, whole
from flx.assets.asset import Asset, Painting, check_asset, check_painting
from flx.files import write_atomically
from flx.viewer.page import NAME, page, shot

START = b"<!doctype html>"


@dataclass(frozen=True)
class Page:
    """A page of the viewer. A notebook shows it in a frame; `save` writes it as a file."""

    content: bytes = field(repr=False)
    height: int = 640  # pixels of the frame

    def save(self, path: str | Path) -> None:
        """Write the page, whole or not at all."""
        write_atomically(path_of("path", path, "a file to write, such as 'viewer.html'"), self.content)

    def _repr_html_(self) -> str:
        # In a sandbox of its own, the page can neither read the notebook nor run code in it.
        rights = 'sandbox="allow-scripts" title="flx viewer"'
        look = f'style="width:100%;height:{self.height}px;border:0"'
        # Letters beyond ASCII as numbers, so that the frame is the same whatever the encoding around it.
        text = escape(self.content.decode()).encode("ascii", "xmlcharrefreplace").decode()
        return f'<iframe {rights} {look} srcdoc="{text}"></iframe>'


def show(
    what: Asset | str | Path, *paintings: Painting, up: Literal["y", "z"] = "y", height: int = 640
) -> Page:
    """The viewer in a notebook: an asset beside paintings of it, or the page that a command wrote.

    Args:
        what: The mesh file; or the folder that `flx sample` or `flx reconstruct` wrote to, or its page.
        paintings: New textures of the asset, from `flx.paint` or `flx.generate`.
        up: The axis that points up.
        height: Pixels of the frame in the notebook.

    Raises ValueError where a folder holds no page, and where a mesh is too large for one.

    Example:
        flx.show("runs/demo/samples")
        flx.show(asset, *flx.generate(generator, count=3))
    """
    height = whole("height", height, 200)
    check_word("up", up, ("y", "z"))
    if isinstance(what, str | Path):
        place = path_of("what", what, "a folder with a viewer.html, or an Asset")
        if paintings:
            raise ValueError(f"{place} is a page already; give an Asset to show paintings of it")
        file = place / NAME if place.is_dir() else place
        if not file.is_file():
            raise ValueError(f"{file} is not there; flx sample and flx reconstruct write it")
        content = file.read_bytes()
        if not content.startswith(START):
            raise ValueError(f"{file} is no page of flx; give a folder with a viewer.html, or flx.load(MESH)")
        return Page(content, height)
    check_asset("what", what)
    for n, painting in enumerate(paintings):
        check_painting(f"painting {n}", painting)
    shots = [shot("input", what), *(shot(f"painting {n}", what, one) for n, one in enumerate(paintings))]
    return Page(page(what.path.name, shots, {}, up), height)
