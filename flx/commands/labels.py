"""`flx labels`: a proposal for labels, from the colours of a texture."""

import os
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tyro.conf import Positional


@dataclass(frozen=True)
class ProposeLabels:
    """Propose an image of labels for `flx train --surface.labels`, to be corrected in any painting program.

    Example: flx labels bob.obj --colors 4 --out labels.png
    """

    mesh: Positional[Path]  # a .glb, .gltf or .obj file with one texture
    colors: int = 4  # how many labels, 2 to 8
    out: Path = Path("labels.png")  # the image to write; one that is there is never replaced
    texture: Path | None = None  # an image to use instead of the file's own
    texture_size: int | None = None  # pixels on the longer side; the texture's, at most 2048, unless given
    vertices: int = 5000  # of the triangulation that carries the regions: fewer make them coarser
    seed: int = 0  # of the triangulation and the clusters

    def __call__(self) -> None:
        print(propose(self))


def propose(options: ProposeLabels) -> Path:
    """Write the image: regions of like colour, each in one flat colour, on the mesh's own UVs.

    Raises ValueError for a mesh without exactly one texture, and for more labels than its colours make.
    """
    from flx.assets.read import read_asset
    from flx.assets.write import write_png
    from flx.files import check_place
    from flx.geometry.atlas import fill_gutter
    from flx.geometry.regions import PALETTE, regions
    from flx.pipeline.canvas import check_size, open_canvas
    from flx.pipeline.copies import triangulate
    from flx.pipeline.labels import Labels, in_words

    check_size(options.texture_size)
    if not 2 <= options.colors <= len(PALETTE):
        raise ValueError(f"--colors is {options.colors}; give 2 to {len(PALETTE)}")
    if options.out.suffix.lower() != ".png":
        raise ValueError(f"--out is {options.out}; name a .png, which keeps flat colours flat")
    check_place(options.out, "name another file with --out")
    if os.path.lexists(options.out):
        raise ValueError(f"{options.out} is there already; name another file with --out")
    asset = read_asset(options.mesh, options.texture)
    flat = sum(texture.flat for texture in asset.textures)
    if (len(asset.textures), flat) != (1, 0):
        raise ValueError(
            f"{asset.path} has {len(asset.textures) - flat} textures and {flat} materials of one colour; flx "
            "labels needs one texture and nothing else"
        )
    copy = triangulate(asset, options.vertices, options.seed)
    rng = np.random.default_rng(options.seed)
    try:
        found = regions(copy.rings.colors.mean(1), copy.triangulation.faces, options.colors, rng)
    except ValueError as fault:
        raise ValueError(f"{asset.path}: {fault}, with --colors") from None

    canvas = open_canvas(asset, copy.triangulation, options.texture_size)
    (atlas,) = canvas.atlases
    assert atlas
    corners = found[copy.triangulation.faces[canvas.faces]]
    there = np.einsum("pkr,pk->pr", corners, canvas.barycentrics).argmax(1)
    image = np.zeros((atlas.height, atlas.width, 3), np.uint8)
    image[atlas.covered] = PALETTE[there]
    options.out.parent.mkdir(parents=True, exist_ok=True)
    write_png(options.out, fill_gutter(image, atlas.covered))
    labels = Labels(PALETTE[: options.colors], found.argmax(1).astype(np.int32))
    print(f"{options.out}: {in_words(labels, copy.tables)}", file=sys.stderr)
    return options.out
