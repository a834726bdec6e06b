# ruff: noqa: E501  (the table of cases: one line each)
"""Files that must be refused, each made by a few lines, and what `flx doctor` does with them.

python tests/reports/hostile.py prints the table: the line that is printed, CPU seconds, peak memory.
"""

import base64
import contextlib
import io
import json
import os
import re
import resource
import signal
import struct
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

sys.path.append(str(Path(__file__).parents[1]))  # a script finds what lies beside it, not helpers
from helpers.files import (
    MTL,
    OBJ,
    PLY,
    Build,
    at,
    beside,
    buffer_uri,
    document,
    floats,
    glb,
    gltf,
    image_uri,
    obj,
    ply,
    ply_binary,
    png,
    png_bomb,
    raw,
    set_,
    special,
    symlink,
)
from reports.measure import forget_peak, peak_megabytes

from flx.launch import main

# ------------------------------------------------------------------------------------------------- cases


class Case(NamedTuple):
    name: str
    build: Build
    match: str  # what its line says


def sparse_file(path: Path) -> None:
    with open(path, "wb") as file:
        file.truncate(20 << 30)


def shown_often(d: dict) -> None:
    d["nodes"] = [{"mesh": 0} for _ in range(200_000)]
    d["scenes"] = [{"nodes": list(range(200_000))}]


def many_big_parts(folder: Path) -> Path:
    d, content = document()
    d["bufferViews"].append({"buffer": 0, "byteOffset": len(content), "byteLength": 3_000_000})
    d["accessors"].append({"bufferView": 4, "componentType": 5126, "count": 249_999, "type": "VEC3"})
    d["meshes"][0]["primitives"] = [{"attributes": {"POSITION": 3}} for _ in range(5000)]
    d["buffers"][0]["byteLength"] += 3_000_000
    (folder / "a.glb").write_bytes(glb(d, content + bytes(3_000_000)))
    return folder / "a.glb"


def views_of_one_buffer(count: int) -> Build:
    def overlap(d: dict) -> None:
        size = d["buffers"][0]["byteLength"] = 1 << 20
        d["bufferViews"] += [{"buffer": 0, "byteOffset": 0, "byteLength": size}] * count

    return gltf(overlap, lambda content: content.extend(bytes(1 << 20)))


def buffers_of_one_file(folder: Path) -> Path:
    d, content = document()
    (folder / "a.bin").write_bytes(content + bytes(1 << 20))
    d["buffers"] = [d["buffers"][0] | {"uri": "a.bin"} for _ in range(4000)]
    (folder / "a.gltf").write_text(json.dumps(d))
    return folder / "a.gltf"


def nested(count: int, **transform: list[float]) -> Build:
    nodes = [{"children": [i + 1], **transform} for i in range(count)]
    return at("nodes", to=[*nodes, {"mesh": 0}])


def instances(d: dict) -> None:
    d["nodes"] = [{"mesh": 0, "translation": [i, 0, 0]} for i in range(10_000)]
    d["scenes"] = [{"nodes": list(range(10_000))}]
    reference = d["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    reference["extensions"] = {"KHR_texture_transform": {"scale": [0.01, 0.01]}}


def ply_of_uneven_rows() -> bytes:
    """Before its mesh, 2 MB of lists that flx does not use: of no value, and of one."""
    head, rest = ply_binary().split(b"element vertex")
    junk = b"element junk 1300000\nproperty list uchar uchar what\nelement vertex"
    header, body = (head + junk + rest).split(b"end_header\n")
    return header + b"end_header\n" + b"\0\1\7" * 650_000 + body


def other_map(name: str) -> Build:
    return obj(mtl=MTL + f"map_Bump {name}\n")


def many_big_maps(folder: Path) -> Path:
    for i in range(5):
        with open(folder / f"b{i}.png", "wb") as file:
            file.truncate(500 << 20)
    return obj(mtl=MTL + "".join(f"norm b{i}.png\n" for i in range(5)))(folder)


def many_bombs(folder: Path) -> Path:
    (folder / "a.png").write_bytes(png_bomb(8000, 8000))
    text, mtl = OBJ[: OBJ.index("usemtl")], ""
    for i in range(5):
        name = f"b{i}.png"
        (folder / name).write_bytes((folder / "a.png").read_bytes())
        text += f"usemtl m{i}\nf 1/1 3/2 2/3\n"
        mtl += f"newmtl m{i}\nmap_Kd {name}\n"
    (folder / "m.mtl").write_text(mtl)
    (folder / "a.obj").write_text(text)
    return folder / "a.obj"


CONFIG = """
from pathlib import Path
from flx.config import FLDMExperiment, Surface
strokes = str(Path(__file__).with_name("strokes.json"))
config = FLDMExperiment(surface=Surface(vertices=5000, copies=1, direction=strokes))
"""


def strokes(content: object) -> Build:
    """An OBJ beside a file of strokes, and a config that names it."""

    def build(folder: Path) -> Path:
        (folder / "config.py").write_text(CONFIG)
        text = content if isinstance(content, str) else json.dumps({"strokes": content})
        (folder / "strokes.json").write_text(text)
        return obj()(folder)

    return build


def stroke(*points: object, **more: object) -> Build:
    return strokes([{"points": points, **more}])


GOOD = {
    "OBJ": obj(),
    "strokes": stroke([0.1, 0.1, 0], [0.3, 0.2, 0]),
    "strokes: a point with a direction": stroke([0.1, 0.1, 0], direction=[1, 0, 0]),
    "PLY, ASCII": ply(PLY),
    "PLY, binary": ply(ply_binary()),
    "GLB": gltf(len),
    # What flx itself does not need is told, and left where it is.
    **{
        f"OBJ, map_Bump {name}": other_map(name)
        for name in ("../a.png", "/etc/hostname", "http://127.0.0.1:9/a.png")
    },
    # An absolute path means the file of that name that lies here, and never the one that lies there.
    "OBJ, map_Kd absolute, its name here": obj(mtl=MTL.replace("a.png", "/etc/a.png")),
    "OBJ, map_Kd absolute, and there too": lambda folder: obj(
        mtl=MTL.replace("a.png", f"{folder.parent}/a.png")
    )(folder),
    "GLB, image of another machine": beside(
        image_uri("C:\\tex\\a.png"), "a.png", lambda path: path.write_bytes(png())
    ),
    "OBJ, map_Bump is a folder": beside(other_map("b.png"), "b.png", os.mkdir),
    "OBJ, map_Bump is a pipe": beside(other_map("b.png"), "b.png", os.mkfifo),
    "OBJ, map_Bump is a device": symlink(other_map("b.png"), "b.png", "/dev/zero"),
    "OBJ, map_Bump of 20 GB": beside(other_map("b.png"), "b.png", sparse_file),
    "GLB, image as data URI": image_uri("data:image/png;base64," + base64.b64encode(png()).decode()),
}
# Much work for their size, and done in bounded time and memory.
HEAVY = {
    "GLB: 400 views of one buffer of 1 MB": views_of_one_buffer(400),
    "glTF: 4,000 buffers of one file of 1 MB": buffers_of_one_file,
    "GLB: 300,000 nested nodes": nested(300_000),
    "GLB: 200,000 nested nodes that turn": nested(200_000, rotation=[0, 1, 0, 0]),
    "GLB: 10,000 instances": gltf(instances),
    "PLY: 2 MB of rows of different lengths": ply(ply_of_uneven_rows()),
}

CASES = [
    # paths
    Case("OBJ: mtllib ../m.mtl", obj(lambda t: t.replace("m.mtl", "../m.mtl")), "outside"),
    Case("OBJ: mtllib /etc/passwd", obj(lambda t: t.replace("m.mtl", "/etc/passwd")), "outside"),
    Case("OBJ: map_Kd ../a.png", obj(mtl=MTL.replace("a.png", "../a.png")), "outside"),
    Case("OBJ: map_Kd absolute", obj(mtl=MTL.replace("a.png", "/etc/hostname")), "outside"),
    Case("OBJ: map_Kd URL", obj(mtl=MTL.replace("a.png", "http://127.0.0.1:9/a.png")), "nothing is fetched"),
    Case("OBJ: map_Kd is a link out", symlink(obj(), "a.png", "/etc/hostname"), "outside"),
    Case("OBJ: map_Kd is a link to itself", symlink(obj(), "a.png", "a.png"), "a.png"),
    Case("OBJ: mtllib is a link out", symlink(obj(), "m.mtl", "/etc/passwd"), "outside"),
    Case("OBJ: map_Kd absolute, not here", obj(mtl=MTL.replace("a.png", "C:\\Users\\b.png")), r"C:\\Users\\b.png' does not exist.*--texture"),
    Case("OBJ: map_Kd in capitals, two files", beside(obj(mtl=MTL.replace("a.png", "A.png")), "a.PNG", lambda path: path.write_bytes(png())), "A.png' does not exist"),
    Case("OBJ: map_Kd in capitals is a link out", symlink(obj(mtl=MTL.replace("a.png", "A.png")), "a.png", "/etc/hostname"), "A.png' does not exist"),
    Case("OBJ: map_Kd in a folder that is a link out", symlink(obj(mtl=MTL.replace("a.png", "OUT/hostname")), "out", "/etc"), "OUT/hostname' does not exist"),
    Case("OBJ: map_Kd is missing", obj(mtl=MTL.replace("a.png", "b.png")), "does not exist.*--texture"),
    Case("OBJ: map_Kd in a file", obj(mtl=MTL.replace("a.png", "a.png/b.png")), "does not exist.*--texture"),
    Case("OBJ: mtllib is missing", obj(lambda t: t.replace("m.mtl", "n.mtl")), "does not exist.*--texture"),
    Case("OBJ: MTL of 20 GB", beside(obj(), "m.mtl", sparse_file), "FLX_MAX_BYTES"),
    Case("OBJ: MTL is a pipe", beside(obj(), "m.mtl", os.mkfifo), "not a file"),
    Case("OBJ: a second MTL is outside", obj(lambda t: t.replace("m.mtl", "m.mtl ../m.mtl")), "outside"),
    Case("OBJ: 5,000 maps", obj(mtl=MTL + "".join(f"norm b{i}.png\n" for i in range(5000))), "maps, more than"),
    Case("OBJ: maps of 2.5 GB", many_big_maps, "FLX_MAX_BYTES"),
    Case("OBJ: map_Kd -s nan", obj(mtl=MTL.replace("a.png", "-s nan a.png")), "does not exist"),
    Case("OBJ: map_Kd -o 1e300", obj(mtl=MTL.replace("a.png", "-o 1e300 a.png")), "not finite, or too far"),
    Case("OBJ: map_Kd with a NUL", obj(mtl=MTL.replace("a.png", "a\0.png")), "null"),
    Case("OBJ: map_Kd of 5,000 letters", obj(mtl=MTL.replace("a.png", "a" * 5000)), "too long"),
    Case("GLB: buffer ../a.bin", buffer_uri("../a.bin"), "outside"),
    Case("GLB: buffer /etc/passwd", buffer_uri("/etc/passwd"), "outside"),
    Case("GLB: buffer %2e%2e%2fa.bin", buffer_uri("%2e%2e%2fa.bin"), "outside"),
    Case("GLB: buffer ..\\a.bin", buffer_uri("..\\a.bin"), "outside"),
    Case("GLB: buffer URL", buffer_uri("http://127.0.0.1:9/a.bin"), "nothing is fetched"),
    Case("GLB: image URL", image_uri("https://127.0.0.1:9/a.png"), "nothing is fetched"),
    Case("GLB: image file://", image_uri("file:///etc/hostname"), "nothing is fetched"),
    Case("GLB: image ../a.png", image_uri("../a.png"), "outside"),
    Case("GLB: image is missing", image_uri("b.png"), "b.png.*--texture"),
    # data URIs
    Case("GLB: data URI too short", buffer_uri("data:;base64,AAAA"), "3 bytes of"),
    Case("GLB: data URI not base64", buffer_uri("data:;base64,A?A"), "data URI.*broken"),
    Case("GLB: data URI without data", buffer_uri("data:"), "0 bytes of"),
    Case("GLB: image data URI of nothing", image_uri("data:image/png;base64,"), "no known kind"),
    # images
    Case("PNG 20,000 × 20,000", obj(image=png_bomb(20000, 20000)), "more than 134,217,728 pixels"),
    Case("PNG 9,000 × 9,000", obj(image=png_bomb(9000, 9000)), "9000 × 9000.*FLX_MAX_PIXELS"),
    Case("five PNGs of 8,000 × 8,000", many_bombs, "5 images have 320,000,000 pixels"),
    Case("PNG header of 2^31 × 2^31", obj(image=png()[:16] + b"\x7f\xff\xff\xff" * 2 + png()[24:]), "a.png"),
    Case("PNG cut off", obj(image=png(64, 64)[:2000]), "broken"),
    Case("PNG cut off in its header", obj(image=png()[:20]), "no known kind"),
    Case("PNG with a wrong checksum", obj(image=png()[:45] + b"?" + png()[46:]), "broken"),
    Case("PNG empty", obj(image=b""), "no known kind"),
    Case("PNG is a text", obj(image=b"no image"), "no known kind"),
    Case("PNG is PostScript", obj(image=b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n"), "no known kind"),
    Case("PNG is KTX2", obj(image=b"\xabKTX 20\xbb\r\n\x1a\n"), "is KTX"),
    Case("PNG is a folder", beside(obj(), "a.png", os.mkdir), "not a file"),
    Case("PNG is a pipe", beside(obj(), "a.png", os.mkfifo), "not a file"),
    Case("PNG is a device", symlink(obj(), "a.png", "/dev/zero"), "outside"),
    Case("PNG of 20 GB", beside(obj(), "a.png", sparse_file), "FLX_MAX_BYTES"),
    # not a mesh
    Case("empty .glb", raw("a.glb", b""), "is empty"),
    Case("empty .obj", raw("a.obj", b""), "is empty"),
    Case("zip", raw("a.zip", b"PK\3\4" + bytes(100)), "not a mesh file"),
    Case("zip called .glb", raw("a.glb", b"PK\3\4" + bytes(100)), "JSON is broken"),
    Case("gzip called .obj", raw("a.obj", b"\x1f\x8b\x08\0" + bytes(100)), "not text, as an OBJ file is"),
    Case("folder called .obj", special("d.obj", os.mkdir), "not a mesh file"),
    Case("pipe called .ply", special("p.ply", os.mkfifo), "not a mesh file"),
    Case("device", symlink(raw("a.ply", b"x"), "a.ply", "/dev/zero"), "not a mesh file"),
    Case("link to nowhere", special("a.glb", lambda path: path.symlink_to("b.glb")), "does not exist"),
    Case("no such file", special("a.glb", str), "does not exist"),
    Case("URL", lambda _: Path("https://127.0.0.1:9/a.glb"), "does not exist"),
    Case("name of 5,000 letters", lambda folder: folder / ("a" * 5000 + ".glb"), "too long"),
    Case("file of 20 GB", special("a.glb", sparse_file), "FLX_MAX_BYTES"),
    # strokes
    Case("strokes: none", strokes([]), "strokes.json: it has no strokes"),
    Case("strokes: empty file", strokes(""), "strokes.json: it is not JSON"),
    Case("strokes: a list", strokes("[]"), "it has no strokes"),
    Case("strokes: 100,000 brackets", strokes("[" * 100_000), "it is not JSON"),
    Case("strokes: 5 million values", strokes("[" + "[]," * 5_000_000 + "0]"), "bytes; give at most"),
    Case("strokes: an integer of 10,000 digits", strokes('{"strokes":' + "9" * 10_000 + "}"), "it is not JSON"),
    Case("strokes: a stroke is a number", strokes([1]), r"strokes\[0\] has no list of points"),
    Case("strokes: a point is a word", stroke("here", "there"), r'points\[0\] is "here"; give three'),
    Case("strokes: a point of NaN", stroke([0, 0, 0], [float("nan"), 0, 0]), r"strokes\[0\].points\[1\] is \[NaN, 0, 0\]; give three finite"),
    Case("strokes: a point of infinity", stroke([float("inf"), 0, 0], [0, 0, 0]), r"points\[0\] is \[Infinity"),
    Case("strokes: a point of 1e300", stroke([1e300, 0, 0], [0, 0, 0]), "give three finite"),
    Case("strokes: an integer of 400 digits", stroke([10**400, 0, 0], [0, 0, 0]), "give three finite"),
    Case("strokes: a point of 2", stroke([0, 0], [0, 0, 0]), r"points\[0\] is \[0, 0\]; give three"),
    Case("strokes: no point", stroke(), "too few points, 0; give two"),
    Case("strokes: one point", stroke([0, 0, 0]), "too few points, 1; give two"),
    Case("strokes: no length", stroke([0, 0, 0], [0, 0, 0]), "has no length"),
    Case("strokes: 20,000 points", stroke(*[[0, 0, 0]] * 20_000), "20,000 points; give at most"),
    Case("strokes: direction of NaN", stroke([0, 0, 0], direction=[0, float("nan"), 0]), r"direction is \[0, NaN, 0\]"),
    Case("strokes: direction 0", stroke([0, 0, 0], direction=[0, 0, 0]), "direction is zero"),
    Case("strokes: at right angles", stroke([0.2, 0.2, 0], direction=[0, 0, 1]), "at right angles to the surface"),
    Case("strokes: far away", stroke([0, 0, 0], [1e140, 0, 0]), "away from the surface"),
    Case("strokes: through the mesh", stroke([0, 0, 0], [0.4, 0.4, 0.2]), "away from the surface"),
    Case("strokes: an unknown field", stroke([0, 0, 0], [1, 0, 0], width=3), "unknown field 'width'"),
    Case("strokes: a folder", beside(strokes([]), "strokes.json", os.mkdir), "not a file"),
    Case("strokes: a pipe", beside(strokes([]), "strokes.json", os.mkfifo), "not a file"),
    Case("strokes: a device", symlink(strokes([]), "strokes.json", "/dev/zero"), "not a file"),
    Case("strokes: 20 GB", beside(strokes([]), "strokes.json", sparse_file), "FLX_MAX_BYTES"),
    # OBJ
    Case("OBJ: points only", raw("a.obj", "v 0 0 0\nv 1 0 0\n"), "no triangles"),
    Case("OBJ: index 0", obj(lambda t: t.replace("f 1/1", "f 0/1")), "counts from 1"),
    Case("OBJ: index out of range", obj(lambda t: t.replace("f 1/1", "f 9/1")), "names v 9"),
    Case("OBJ: index -9", obj(lambda t: t.replace("f 1/1", "f -9/1")), "names v -9"),
    Case("OBJ: index of 30 digits", obj(lambda t: t.replace("f 1/1", "f " + "9" * 30 + "/1")), "names v"),
    Case("OBJ: texture index out of range", obj(lambda t: t.replace("f 1/1", "f 1/7")), "names vt 7"),
    Case("OBJ: NaN vertex", obj(lambda t: t.replace("v 1 0 0", "v nan 0 0")), "not finite"),
    Case("OBJ: Inf vertex", obj(lambda t: t.replace("v 1 0 0", "v inf 0 0")), "not finite"),
    Case("OBJ: vertex 1e308", obj(lambda t: t.replace("v 1 0 0", "v 1e308 0 0")), "too far"),
    Case("OBJ: NaN texture coordinate", obj(lambda t: t.replace("vt 1 0", "vt nan 0")), "not finite"),
    Case("OBJ: texture coordinate 1e9", obj(lambda t: t.replace("vt 1 0", "vt 1e9 0")), "covers its textures"),
    Case("OBJ: a word for a number", obj(lambda t: t.replace("v 1 0 0", "v one 0 0")), "'one' is not a number"),
    Case("OBJ: a sign for an index", obj(lambda t: t.replace("f 1/1", "f 1/-")), "'-' is not a number"),
    Case("OBJ: vertex of two numbers", obj(lambda t: t.replace("v 1 0 0", "v 1 0")), "needs 3 numbers"),
    Case("OBJ: face of two corners", obj(lambda t: t + "f 1/1 2/2\n"), "2 corners"),
    Case("OBJ: cut off", obj(lambda t: t[: t.index("f 1/1 2/2") + 8]), "2 corners"),
    Case("OBJ: all in one place", obj(lambda t: re.sub("^v .*", "v 1 1 1", t, flags=re.MULTILINE)), "no triangles"),
    Case("OBJ: all in one line", obj(lambda t: t.replace("v 0 1 0", "v 2 0 0").replace("v 0 0 1", "v 3 0 0")), "zero area"),
    Case("OBJ: no texture coordinates", obj(lambda t: t.replace("f 1/1 3/2 2/3", "f 1 3 2")), "no texture coordinates"),
    Case("OBJ: 5,000 materials", obj(lambda t: t + "".join(f"usemtl m{i}\nf 1/1 3/2 2/3\n" for i in range(5000))), "materials"),
    # PLY
    Case("PLY: no header", ply(b"solid"), "not a PLY header"),
    Case("PLY: no end of header", ply(PLY[: PLY.index("end_header")]), "not a PLY header"),
    Case("PLY: cut off, ASCII", ply(PLY[:-12]), "too short|cut off"),
    Case("PLY: cut off, binary", ply(ply_binary()[:-3]), "too short|cut off"),
    Case("PLY: 1e9 vertices, ASCII", ply(PLY.replace("vertex 4", "vertex 1000000000")), "too short"),
    Case("PLY: 1e9 vertices, binary", ply(ply_binary(vertices=10**9)), "too short"),
    Case("PLY: 1e12 faces, binary", ply(ply_binary(faces=10**12)), "too short"),
    Case("PLY: -1 vertices", ply(PLY.replace("vertex 4", "vertex -1")), "header line"),
    Case("PLY: a face of 4e9 corners", ply(ply_binary().replace(b"uchar int", b"uint int")), "too short|cut off"),
    Case("PLY: a face of 255 corners", ply(PLY.replace("3 0 2 1", "255 0 2 1")), "cut off"),
    Case("PLY: a face of -3 corners", ply(PLY.replace("3 0 2 1", "-3 0 2 1")), "cut off or broken"),
    Case("PLY: index out of range", ply(PLY.replace("3 0 2 1", "3 0 2 9")), "vertex 9 of 4"),
    Case("PLY: index -1", ply(PLY.replace("3 0 2 1", "3 0 2 -1")), "vertex -1 of 4"),
    Case("PLY: index 1.5", ply(PLY.replace("3 0 2 1", "3 0 2 1.5")), "vertex 1.5 of 4"),
    Case("PLY: NaN vertex", ply(PLY.replace("1 0 0 0 255 0", "nan 0 0 0 255 0")), "not finite"),
    Case("PLY: two textures, faces of neither", ply(PLY.replace("element v", "comment TextureFile a.png\n" * 2 + "element v")), "texnumber"),
    Case("PLY: texture ../a.png", ply(PLY.replace("element v", "comment TextureFile ../a.png\nelement v").replace("uchar red", "float s").replace("uchar green", "float t")), "outside"),
    # glTF: the file
    Case("GLB: cut off", lambda f: raw("a.glb", gltf(len)(f).read_bytes()[:-40])(f), "bytes; export"),
    Case("GLB: cut off after 10 bytes", raw("a.glb", b"glTF\2\0\0\0\xff\0"), "GLB version"),
    Case("GLB: chunk of 4 GB", lambda f: raw("a.glb", gltf(len)(f).read_bytes()[:12] + b"\xf0\xff\xff\xff" + gltf(len)(f).read_bytes()[16:])(f), "ends past the file"),
    Case("GLB: version 1", lambda f: raw("a.glb", b"glTF\1" + gltf(len)(f).read_bytes()[5:])(f), "version 1"),
    Case("GLB: no JSON", raw("a.glb", struct.pack("<4sIII4s", b"glTF", 2, 20, 0, b"BIN\0")), "without a JSON"),
    Case("glTF: not JSON", raw("a.gltf", b"{"), "JSON is broken"),
    Case("glTF: a list", raw("a.gltf", b"[]"), "not an object"),
    Case("glTF: 100,000 brackets", raw("a.gltf", b"[" * 100_000), "JSON is broken"),
    Case("glTF: 5 million values", raw("a.gltf", b"[" + b"[]," * 5_000_000 + b"0]"), "values, more than"),
    Case("glTF: an integer of 10,000 digits", raw("a.gltf", b'{"scene":' + b"9" * 10_000 + b"}"), "JSON is broken"),
    Case("glTF 1.0", at("asset", "version", to="1.0"), "glTF version '1.0'"),
    # glTF: references and counts
    Case("GLB: accessor of 1e9 rows", at("accessors", 0, "count", to=10**9), "do not fit"),
    Case("GLB: indices of 1e9 rows", at("accessors", 2, "count", to=10**9), "do not fit"),
    Case("GLB: 1e9 rows of stride 0", gltf(lambda d: (set_(d, "accessors", 0, "count", to=10**9), set_(d, "bufferViews", 0, "byteStride", to=0))), "do not fit"),
    Case("GLB: 1e9 sparse rows of nothing", at("accessors", 0, to={"componentType": 5126, "count": 10**9, "type": "VEC3", "sparse": {"count": 1, "indices": {"bufferView": 2, "componentType": 5123}, "values": {"bufferView": 0}}}), "no data"),
    Case("GLB: 200,000 nodes of one mesh", gltf(shown_often), "more than 16,384 parts"),
    Case("GLB: 5,000 parts of one 3 MB accessor", many_big_parts, "faces, more than"),
    Case("GLB: 4,000 views of one buffer of 1 MB", views_of_one_buffer(4000), "4,004 buffer views .* overlap"),
    Case("GLB: count -1", at("accessors", 0, "count", to=-1), "not a whole number"),
    Case("GLB: count 4.5", at("accessors", 0, "count", to=4.5), "not a whole number"),
    Case("GLB: offset -4", at("bufferViews", 0, "byteOffset", to=-4), "not a whole number"),
    Case("GLB: view past its buffer", at("bufferViews", 0, "byteOffset", to=1 << 40), "ends past its buffer"),
    Case("GLB: accessor -1", at("meshes", 0, "primitives", 0, "indices", to=-1), "not one of 3 accessors"),
    Case("GLB: accessor 99", at("meshes", 0, "primitives", 0, "indices", to=99), "not one of 3 accessors"),
    Case("GLB: material 7", at("meshes", 0, "primitives", 0, "material", to=7), "not one of 1 materials"),
    Case("GLB: normal map 7", at("materials", 0, "normalTexture", to={"index": 7}), "not one of 1 textures"),
    Case("GLB: nodes are a word", at("nodes", to="all"), "not one of 0 nodes"),
    Case("GLB: a matrix of 15", at("nodes", 0, "matrix", to=[1.0] * 15), "not 16 numbers"),
    Case("GLB: a matrix of NaN", at("nodes", 0, "matrix", to=[float("nan")] * 16), "not a number"),
    Case("GLB: a node is its own child", at("nodes", 0, "children", to=[0]), "own ancestor"),
    Case("GLB: a cycle of nodes", gltf(lambda d: d.update(nodes=[{"mesh": 0, "children": [1]}, {"children": [2]}, {"children": [1]}])), "child twice|own ancestor"),
    Case("GLB: a node of two parents", gltf(lambda d: d.update(nodes=[{"children": [2]}, {"children": [2]}, {"mesh": 0}])), "child twice"),
    Case("GLB: a node shown twice", at("scenes", 0, "nodes", to=[0, 0]), "twice"),
    Case("GLB: no scene", at("scenes", 0, "nodes", to=[]), "no triangles"),
    Case("GLB: lines only", at("meshes", 0, "primitives", 0, "mode", to=1), "no triangles"),
    # glTF: numbers
    Case("GLB: 10,000 nested nodes that grow", nested(10_000, scale=[1.1] * 3), "not finite"),
    Case("GLB: NaN vertex", gltf(len, floats(12, np.nan)), "not finite"),
    Case("GLB: Inf vertex", gltf(len, floats(12, np.inf)), "not finite"),
    Case("GLB: NaN texture coordinate", gltf(len, floats(48, np.nan)), "not finite"),
    Case("GLB: texture coordinate 1e30", gltf(len, floats(48, 1e30)), "too far|covers its textures"),
    Case("GLB: index 65535 of 4", gltf(len, lambda b: struct.pack_into("<H", b, 80, 65535)), "names vertex 65535"),
    # glTF: what is not read
    Case("GLB: Draco", at("extensionsUsed", to=["KHR_draco_mesh_compression"]), "KHR_draco_mesh_compression"),
    Case("GLB: meshopt", at("extensionsUsed", to=["EXT_meshopt_compression"]), "EXT_meshopt_compression"),
    Case("GLB: KTX2 texture", gltf(lambda d: d.update(extensionsRequired=["KHR_texture_basisu"], textures=[{"extensions": {"KHR_texture_basisu": {"source": 0}}}])), "KHR_texture_basisu"),
    Case("GLB: an extension that it requires", at("extensionsRequired", to=["EXT_mesh_gpu_instancing"]), "EXT_mesh_gpu_instancing"),
]  # fmt: skip


# ------------------------------------------------------------------------------------------------- runner


class Outcome(NamedTuple):
    status: int
    lines: list[str]  # of stderr
    said: str  # on stdout
    seconds: float  # CPU
    megabytes: float  # most memory in use
    written: list[str]
    opened: list[str]  # files outside the folder, hosts


def run(build: Build) -> Outcome:
    """`flx doctor` on one file, watched."""
    with TemporaryDirectory() as name:
        folder = Path(name).resolve() / "inner"
        folder.mkdir()
        for secret in ("a.png", "a.bin", "m.mtl"):
            (folder.parent / secret).write_bytes(png())
        path = build(folder)
        before = sorted(os.listdir(folder)), sorted(os.listdir(folder.parent))
        _watched.clear()
        forget_peak()
        said, told, start = io.StringIO(), io.StringIO(), time.process_time()
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(told):
            signal.alarm(60)
            try:
                config = folder / "config.py"
                status = main(["doctor", str(path), *(["--config", str(config)] if config.exists() else [])])
            except BaseException as uncaught:
                status = -1
                print(f"{type(uncaught).__name__}: {uncaught}", file=sys.stderr)
            signal.alarm(0)
        seconds = time.process_time() - start
        strangers = [w for w in _watched if not w.startswith(str(folder)) and not _is_ours(w)]
        after = sorted(os.listdir(folder)), sorted(os.listdir(folder.parent))
        peak = peak_megabytes()
        lines = told.getvalue().replace(str(folder) + "/", "").splitlines()
        written = [name for a, b in zip(before, after, strict=True) for name in set(b) - set(a)]
        return Outcome(status, lines, said.getvalue(), seconds, peak, written, strangers)


_watched: list[str] = []


def _watch(event: str, arguments: tuple) -> None:
    if event in ("open", "socket.connect", "socket.getaddrinfo", "subprocess.Popen", "os.system", "os.exec"):
        _watched.append(str(arguments[0]))


def _is_ours(path: str) -> bool:
    """Modules that are imported on the way, the runner's own files, and what says how much memory there is."""
    memory = path == "/proc/meminfo" or path.startswith("/sys/fs/cgroup/memory.")
    ours = path.startswith(("/proc/self/", sys.prefix, sys.base_prefix)) or memory
    return ours or path.endswith((".py", ".pyc", ".so"))


def _too_long(*_: object) -> None:
    raise TimeoutError("60 seconds")


def table() -> dict[str, Outcome]:
    """Every case, good ones first."""
    resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30))
    signal.signal(signal.SIGALRM, _too_long)
    sys.addaudithook(_watch)
    sys.dont_write_bytecode = True  # of configs
    return {name: run(build) for name, build in (GOOD | HEAVY).items()} | {
        c.name: run(c.build) for c in CASES
    }


if __name__ == "__main__":
    rows = table()
    if "--json" in sys.argv:
        print(json.dumps({name: row._asdict() for name, row in rows.items()}))
    else:
        print("| case | printed | CPU s | MB |\n|---|---|---|---|")
        for name, row in rows.items():
            line = " / ".join(row.lines)[:300] or "(accepted)"
            print(f"| {name} | {row.status}: {line} | {row.seconds:.2f} | {row.megabytes:.0f} |")
