"""`flx bench`: timings of this machine."""

import json
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional


@dataclass(frozen=True)
class Bench:
    """Time this machine and print one JSON object.

    Example: flx bench --mesh > bench.json
    """

    path: Positional[Path | None] = None  # a mesh file for --mesh; the embedded vase unless given
    mesh: bool = False  # time the geometry (CPU seconds) instead of the networks
    texture: Path | None = None  # an image to use instead of the file's own

    def __call__(self) -> None:
        if self.path is not None and not self.mesh:
            raise ValueError(f"{self.path} is for --mesh; the networks are timed without a file")
        from flx.evaluation.timings import codec_rows, denoiser_rows, machine, mesh_rows

        rows = mesh_rows(self.path, self.texture) if self.mesh else [*codec_rows(), *denoiser_rows()]
        print(json.dumps({"rows": rows, "machine": machine()}, indent=2))
