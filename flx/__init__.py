"""flx learns the texture of one mesh and makes new ones.

    import flx

    asset = flx.load("bowl.glb")
    copy = flx.triangulate(asset, vertices=5000)
    codec = flx.load_codec()
    back = flx.paint(asset, copy, codec, codec.encode(copy.rings))
    flx.save(asset, back, "back.glb")

    for n, painting in enumerate(flx.patchworks(flx.patch_generator(asset), count=4)):
        flx.save(asset, painting, f"instant_{n}.glb")

    flx.train(flx.quick("bowl.glb", name="bowl"))
    generator = flx.load_generator("runs/bowl")
    for n, painting in enumerate(flx.generate(generator, count=4)):
        flx.save(generator.asset, painting, f"variation_{n}.glb")

The names below are loaded when they are first used: `import flx` loads neither JAX nor a mesh library. The
equations are in `flx.fields`, for JAX. The other rooms (`flx.geometry`, `flx.models`…) may be imported too,
but may change: docs/architecture.md.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from flx.assets.arrays import from_arrays, from_trimesh, to_trimesh
    from flx.assets.read import read_asset as load
    from flx.assets.shape import read_shape as load_shape
    from flx.assets.vase import vase_asset as vase
    from flx.assets.write import write as save
    from flx.commands.train import learn as train
    from flx.config import FLDM, FLVAE, FLDMExperiment, FLVAEExperiment, Images, Surface, Train, quick
    from flx.controls import Controls, Patches
    from flx.evaluation.fidelity import fidelity
    from flx.geometry.tables import mesh_tables
    from flx.pipeline.canvas import paint, picture
    from flx.pipeline.codec import load_codec
    from flx.pipeline.copies import triangulate
    from flx.pipeline.instant import patch_generator, patchworks
    from flx.pipeline.variations import generate
    from flx.training.load import load_generator
    from flx.types import Triangulation
    from flx.viewer.notebook import show

_HOME = {
    "load": "assets.read:read_asset",
    "load_shape": "assets.shape:read_shape",
    "from_arrays": "assets.arrays",
    "from_trimesh": "assets.arrays",
    "to_trimesh": "assets.arrays",
    "vase": "assets.vase:vase_asset",
    "triangulate": "pipeline.copies",
    "mesh_tables": "geometry.tables",
    "Triangulation": "types",
    "load_codec": "pipeline.codec",
    "paint": "pipeline.canvas",
    "picture": "pipeline.canvas",
    "show": "viewer.notebook",
    "save": "assets.write:write",
    "fidelity": "evaluation.fidelity",
    "quick": "config",
    "train": "commands.train:learn",
    "load_generator": "training.load",
    "generate": "pipeline.variations",
    "patch_generator": "pipeline.instant",
    "patchworks": "pipeline.instant",
    **dict.fromkeys(
        (
            "FLDM",
            "FLVAE",
            "FLDMExperiment",
            "FLVAEExperiment",
            "Images",
            "Surface",
            "Train",
        ),
        "config",
    ),
    **dict.fromkeys(("Controls", "Patches"), "controls"),
}

__all__ = ["__version__", *_HOME]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'flx' has no attribute {name!r}")
    module, _, attribute = _HOME[name].partition(":")
    value = getattr(import_module(f"flx.{module}"), attribute or name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME})
