"""`flx evaluate`: how well each method keeps the textures of some meshes."""

from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from flx.config import Compared


@dataclass(frozen=True)
class Evaluate:
    """Measure methods side by side: table.json and table.md. Rows that are already there are kept.

    Example: flx evaluate --reconstruction bowl.glb can.glb --vertices 30000 5000 --images photos --out table
    """

    reconstruction: tuple[str, ...]  # textures to send: MESH, MESH:TEXTURE, or an image as a sheet
    out: Path  # folder to write to
    vertices: tuple[int, ...] = (30_000, 5_000)  # of the triangulations; one row each
    methods: tuple[Compared, ...] = get_args(Compared)  # which methods to measure
    images: Path | None = None  # folder of images to fit pca and frame_pca to; skipped without it
    texture_size: int | None = None  # pixels on the longer side; the input's, at most 2048, unless given
    weights: str | None = None  # an FL-VAE file; the released one unless given
    seed: int = 0  # of the triangulations
    atlases: bool = False  # also write each new row's texture

    def __call__(self) -> None:
        from flx.evaluation.reconstruction import markdown, reconstruction_table

        rows = reconstruction_table(
            self.reconstruction,
            self.vertices,
            self.methods,
            self.images,
            self.weights,
            self.texture_size,
            self.seed,
            self.out,
            self.atlases,
        )
        print(markdown(rows), end="")
