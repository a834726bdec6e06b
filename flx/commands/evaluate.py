"""`flx evaluate`: how well each method keeps the textures of some meshes."""

from dataclasses import dataclass

from flx.config import Comparison


@dataclass(frozen=True)
class Evaluate(Comparison):
    """Measure methods side by side: table.json and table.md. Rows that are already there are kept.

    Example: flx evaluate --reconstruction bowl.glb can.glb --vertices 30000 5000 --images photos --out table
    """

    def __call__(self) -> None:
        from flx.evaluation.reconstruction import markdown, reconstruction_table

        print(markdown(reconstruction_table(self)), end="")
