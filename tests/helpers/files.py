"""Small files of every format that is read, each correct as it stands."""

import io
import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh
from helpers.surfaces import icosphere
from PIL import Image

OBJ = """mtllib m.mtl
v 0 0 0
v 1 0 0
v 0 1 0
v 0 0 1
vt 0 0
vt 1 0
vt 0 1
usemtl skin
f 1/1 3/2 2/3
f 1/1 2/2 4/3
f 1/1 4/2 3/3
f 2/1 3/2 4/3
"""
MTL = "newmtl skin\nmap_Kd a.png\n"
PLY = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
element face 4
property list uchar int vertex_indices
end_header
0 0 0 255 0 0
1 0 0 0 255 0
0 1 0 0 0 255
0 0 1 9 99 199
3 0 2 1
3 0 1 3
3 0 3 2
3 1 2 3
"""


def png(width: int = 4, height: int = 4) -> bytes:
    content = io.BytesIO()
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (height, width, 3), np.uint8)).save(
        content, "PNG"
    )
    return content.getvalue()


def ply_binary(vertices: int = 4, faces: int = 4) -> bytes:
    """PLY above, little endian; the header may claim other counts."""
    head = PLY[: PLY.index("end_header")].replace("ascii", "binary_little_endian")
    head = head.replace("vertex 4", f"vertex {vertices}").replace("face 4", f"face {faces}") + "end_header\n"
    rows = [line.split() for line in PLY[PLY.index("end_header") :].splitlines()[1:]]
    body = b"".join(struct.pack("<fffBBB", *map(float, r[:3]), *map(int, r[3:])) for r in rows[:4])
    return head.encode() + body + b"".join(struct.pack("<Biii", *map(int, r)) for r in rows[4:])


def document() -> tuple[dict, bytes]:
    """A textured tetrahedron as a glTF document and its buffer."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    uvs = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], np.float32)
    faces = np.array([0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3], np.uint16)
    views = [points.tobytes(), uvs.tobytes(), faces.tobytes(), png()]
    starts = np.cumsum([0, *(len(view) for view in views)]).tolist()
    return {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}]}
        ],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 3, "mimeType": "image/png"}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5126, "count": 4, "type": "VEC2"},
            {"bufferView": 2, "componentType": 5123, "count": 12, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": len(view)}
            for start, view in zip(starts, views, strict=False)
        ],
        "buffers": [{"byteLength": starts[-1]}],
    }, b"".join(views)


def glb(document: dict, binary: bytes) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    binary += bytes(-len(binary) % 4)
    chunks = (
        struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    )
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


Build = Callable[[Path], Path]  # writes files into a folder, and says which one is the mesh


def obj(change: Callable[[str], str] = str, mtl: str = MTL, image: bytes | None = None) -> Build:
    def build(folder: Path) -> Path:
        (folder / "a.png").write_bytes(png() if image is None else image)
        (folder / "m.mtl").write_text(mtl)
        (folder / "a.obj").write_text(change(OBJ))
        return folder / "a.obj"

    return build


def colored_ball(folder: Path) -> Path:
    """A sphere with smooth vertex colours and normals, as PLY."""
    vertices, faces = icosphere(2)
    colors = np.rint(127 * (vertices + 1)).astype(np.uint8)
    mesh = trimesh.Trimesh(vertices.astype(np.float32), faces, vertex_colors=colors, process=False)
    (folder / "ball.ply").write_bytes(trimesh.exchange.ply.export_ply(mesh, vertex_normal=True))
    return folder / "ball.ply"


def png_bomb(width: int, height: int) -> bytes:
    """A grey PNG of one colour, made row by row: large inside, small outside."""
    squeeze, row = zlib.compressobj(9), bytes(width + 1)
    data = b"".join(squeeze.compress(row) for _ in range(height)) + squeeze.flush()

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def ply(content: str | bytes) -> Build:
    return raw("a.ply", content)


def raw(name: str, content: str | bytes) -> Build:
    def build(folder: Path) -> Path:
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
        return folder / name

    return build


def gltf(change: Callable[[dict], object], binary: Callable[[bytearray], object] = len) -> Build:
    """The GLB with its document (and its bytes) changed in place."""

    def build(folder: Path) -> Path:
        changed, content = document()
        content = bytearray(content)
        change(changed), binary(content)
        (folder / "a.glb").write_bytes(glb(changed, bytes(content)))
        return folder / "a.glb"

    return build


def image_uri(uri: str) -> Build:
    return gltf(lambda d: d.update(images=[{"uri": uri}]))


def buffer_uri(uri: str) -> Build:
    return gltf(lambda d: d.update(buffers=[d["buffers"][0] | {"uri": uri}]))


def symlink(build: Build, name: str, target: str) -> Build:
    def linked(folder: Path) -> Path:
        path = build(folder)
        (folder / name).unlink(missing_ok=True)
        (folder / name).symlink_to(target)
        return path

    return linked


def special(name: str, make: Callable[[Path], object]) -> Build:
    def build(folder: Path) -> Path:
        make(folder / name)
        return folder / name

    return build


def beside(build: Build, name: str, make: Callable[[Path], object]) -> Build:
    """As `build`, with something else in the place of one of its files."""

    def changed(folder: Path) -> Path:
        path = build(folder)
        (folder / name).unlink(missing_ok=True)
        make(folder / name)
        return path

    return changed


def set_(d: dict, *keys: str | int, to: object) -> None:
    for key in keys[:-1]:
        d = d[key]
    d[keys[-1]] = to


def at(*keys: str | int, to: object) -> Build:
    return gltf(lambda d: set_(d, *keys, to=to))


def floats(offset: int, *values: float) -> Callable[[bytearray], None]:
    return lambda content: struct.pack_into(f"<{len(values)}f", content, offset, *values)


def corners(parts) -> np.ndarray:
    """Positions, texture coordinates and colours of every corner of every face."""
    rows = []
    for part in parts:
        columns = [part.positions, part.uvs, part.normals, part.colors]
        rows.append(np.concatenate([c[part.faces] for c in columns if c is not None], -1))
    return np.concatenate(rows)
