"""The page that a verb writes last: the input and what was made of it, to be looked at in a browser."""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from flx.files import write_atomically
from flx.viewer.page import NAME, Shot, page


def write_viewer(
    out: Path, title: str, shots: Sequence[Shot], settings: Mapping[str, Any], up: Literal["y", "z"]
) -> None:
    """Write viewer.html. Where that fails, a line says why, and no older page is left: the meshes are there,
    and a page of others would mislead."""
    try:
        write_atomically(out / NAME, page(title, shots, settings, up))
    except Exception as fault:
        (out / NAME).unlink(missing_ok=True)
        why = " ".join(str(fault).split()) or type(fault).__name__
        print(f"flx: {out / NAME} was not written ({why}); --no-viewer leaves it out", file=sys.stderr)


def name_viewer(out: Path) -> None:
    """Say where the page is, if there is one, on stderr: what is on stdout is for scripts."""
    if (out / NAME).exists():
        print(f"flx: to look at them, open {out / NAME} in a browser", file=sys.stderr, flush=True)
