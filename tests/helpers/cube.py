"""A cube of quads as an OBJ full of what an OBJ may say, with its MTL and its maps."""

from pathlib import Path

import numpy as np
from PIL import Image

from flx.assets.asset import Asset

# A cube of quads, a triangle pair and two materials; one face goes on in the next line.
CUBE = """# made by hand, ünïcode
mtllib my cube.mtl
o cube
v 0 0 0
v 1 0 0 # right
v 1 1 0
v 0 1 0
v 0 0 1
v 1 0 1
v 1.0 1.0 1.0
v 0 1 1.30000000000000004
vt 0 0
vt 1 0
vt 1 1
vt 0 1
vn 0 0 1
vp 0.5
g bottom sides
s 1
usemtl wood
f 1/1 4/4 3/3 2/2
f 1/1 2/2 \\
  6/3 5/4
\tf 2/1 3/2 7/3 6/4

g top
s off
usemtl bone white
f 5/1 6/2 7/3 8/4
usemtl wood
f 3/1 4/2 8/3 7/4
f 4/1 1/2 5/3
f 4/1 5/3 8/4
l 1 2
# a comment goes on too \\
 v 7 7 7 \\
 mtllib my cube.mtl
# the end"""


# the end"""
MTL = """# materials of C:\\
newmtl wood
Ns 96.5
Kd 0.8 0.8 0.8
illum 2
d 1.0
map_Kd -clamp on -s 1 1 1 textures/wood grain.png
map_Bump -bm 0.4 textures\\bump.png
norm textures/normal.tga
map_Ks textures/wood grain.png

newmtl bone white
\tKd 0.2 0.4 0.6
map_d gone.png
newmtl unused
map_Kd textures/unused.jpg
"""


def saved(folder: Path, obj: str = CUBE, mtl: str = MTL, end: str = "\n") -> Path:
    (folder / "textures").mkdir(parents=True)
    Image.new("RGBA", (8, 4), (10, 20, 30, 77)).save(folder / "textures" / "wood grain.png")
    for name in ("bump.png", "normal.tga", "unused.jpg"):
        (folder / "textures" / name).write_bytes(f"bytes of {name}".encode())
    (folder / "my cube.mtl").write_bytes(mtl.replace("\n", end).encode())
    (folder / "cube.obj").write_bytes(obj.replace("\n", end).encode())
    return folder / "cube.obj"


def new_images(asset: Asset) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [rng.integers(0, 256, (16, 8, 3), np.uint8) for _ in asset.textures]


def changed(before: Path, after: Path) -> list[tuple[bytes, bytes]]:
    """The lines that differ; there are as many in both."""
    both = (path.read_bytes().splitlines(keepends=True) for path in (before, after))
    return [pair for pair in zip(*both, strict=True) if pair[0] != pair[1]]


def files(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir()}


def same_bits(a: Asset, b: Asset) -> bool:
    """Geometry and coordinates; images may differ."""
    of = lambda m: (m.vertices, m.faces, m.corner_uvs, m.face_textures)  # noqa: E731
    return all(np.array_equal(x, y) for x, y in zip(of(a.mesh), of(b.mesh), strict=True))


def colored(scale: float, more: str = "") -> str:
    """The cube with a colour at each v, the last v unused."""
    colors = np.random.default_rng(1).integers(2, 256, (9, 3)) / 255
    rows = iter(colors)
    lines = []
    for line in CUBE.replace("vp 0.5", "v 9 9 9").splitlines():
        if line.startswith("v "):
            told = " ".join(f"{c * scale:.6g}" for c in next(rows))
            line = " ".join([*line.split()[:4], told]) + more
        lines.append(line)
    return "\n".join(lines).replace("v 0 1 0 ", "v\t0 1 \\\n 0  ")
