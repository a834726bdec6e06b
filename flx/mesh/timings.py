"""What geometry costs on this machine: remeshing, tables, rasterising an atlas, a view; and memory."""

import resource
import sys
import time
from collections.abc import Callable
from typing import Any

from flx.mesh.render import render
from flx.mesh.tables import mesh_tables
from flx.mesh.texels import atlas_texels
from flx.mesh.triangulations import remesh
from flx.types import TexturedMesh

ATLAS = 4096  # texels a side


def geometry_rows(mesh: TexturedMesh, vertices: int = 30_000) -> list[dict[str, Any]]:
    """CPU seconds of each stage, and the most memory the process has held by its end.

    A mesh without textures has no atlas and no such row.
    """
    rows = []

    def timed(name: str, call: Callable[[], Any]) -> Any:
        start = time.process_time()
        result = call()
        seconds = time.process_time() - start
        rows.append({"name": name, "seconds": seconds, "peak_bytes": peak_bytes()})
        return result

    copy = timed(f"remesh/{vertices}", lambda: remesh(mesh.vertices, mesh.faces, vertices, seed=0))
    timed(f"tables/{vertices}", lambda: mesh_tables(copy))
    if mesh.textures:
        timed(f"texels/{ATLAS}", lambda: atlas_texels(mesh, 0, ATLAS, ATLAS))
    timed(f"render/{len(mesh.faces)} faces", lambda: render(mesh))
    return rows


def peak_bytes() -> int:
    """The most memory that this process has held until now."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak << 10  # in KiB but on macOS
