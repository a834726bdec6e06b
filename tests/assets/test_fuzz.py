"""Law of mutated files: read, or refused as a ValueError of one line; never slow, never large.

FLX_FUZZ=10000 runs as many cases of each kind; a hundred is what a test run can wait for.
"""

import copy
import math
import os
import re
import resource
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from random import Random

import pytest
from helpers import files
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flx.assets.read import read_asset

CASES = int(os.environ.get("FLX_FUZZ", "100"))
ODD = (-1, 0, 1, 2, 3, 7, 255, 65535, 1 << 31, 1 << 40, 0.5, -0.0, 1e-300, 1e30, 1e300, math.nan, math.inf)
ODD_VALUES = (*ODD, None, True, "", "a.png", "../a.png", "data:,", "VEC3", [], {}, [0], [[]], {"index": 0})
WORDS = (*map(str, ODD), "-inf", "1e999", "9" * 30, "x", "/", "1//1", "1/1/1", "#", "list", "uint", "\\")
NAMES = ("byteStride", "byteOffset", "sparse", "mode", "normalized", "uri", "extensions", "scene")


def changed_bytes(content: bytes, random: Random) -> bytes:
    """Bytes overwritten, cut off, cut out, copied elsewhere; often but one, for most others are fatal."""
    for _ in range(random.choice((1, 1, 2, 3))):
        size = len(content)
        a, b = sorted(random.sample(range(size + 1), 2))
        match random.choice(("overwrite",) * 6 + ("cut off", "cut out", "copy")):
            case "overwrite":
                new = random.randbytes(random.choice((1, 1, 2, 4)))
                content = content[:b] + new + content[b + len(new) :]
            case "cut off":
                content = content[: max(b, size // 2)]
            case "cut out":
                content = content[:a] + content[min(b, a + 16) :]
            case "copy":
                content = content[:b] + content[a : min(b, a + 200)] + content[b:]
    return content


def changed_words(text: str, random: Random) -> bytes:
    """Words and lines of a text exchanged, doubled, left out."""
    for _ in range(random.randint(1, 3)):
        pieces = re.split(random.choice((r"(\s+)", r"(\n)", r"([/\s]+)")), text)
        at = random.randrange(len(pieces))
        other = random.choice((random.choice(WORDS), random.choice(pieces), pieces[at] * 2, ""))
        text = "".join([*pieces[:at], other, *pieces[at + 1 :]])
    return text.encode()


def changed_document(random: Random) -> bytes:
    """A GLB whose JSON has values of another kind, or none, in a few places."""
    document, binary = files.document()
    document["materials"][0]["normalTexture"] = {"index": 0}
    document["nodes"][0] |= {"rotation": [0, 0, 0, 1], "children": [1]}
    document["nodes"].append({"matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], "mesh": 0})
    slot = document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    slot["extensions"] = {"KHR_texture_transform": {"scale": [1, 1], "offset": [0, 0], "rotation": 0}}
    for _ in range(random.randint(1, 3)):
        place, parent, key = document, None, None
        while isinstance(place, dict | list) and place and (parent is None or random.random() < 0.8):
            parent, key = place, random.choice(list(place) if isinstance(place, dict) else range(len(place)))
            place = place[key]
        if parent is None:
            break
        value = copy.deepcopy(random.choice(ODD_VALUES))
        match random.choice(("value", "value", "delete", "add")):
            case "value":
                parent[key] = value
            case "delete":
                del parent[key]
            case "add" if isinstance(parent, list):
                parent.append(copy.deepcopy(parent[key]))
            case "add":
                parent[random.choice(NAMES)] = value
    return files.glb(document, binary)


GLB = files.glb(*files.document())
KINDS: dict[str, tuple[str, Callable[[Random], bytes]]] = {
    "GLB, bytes": ("a.glb", partial(changed_bytes, GLB)),
    "GLB, document": ("a.glb", changed_document),
    "OBJ, bytes": ("a.obj", partial(changed_bytes, files.OBJ.encode())),
    "OBJ, words": ("a.obj", partial(changed_words, files.OBJ)),
    "MTL, words": ("m.mtl", partial(changed_words, files.MTL)),
    "PLY, bytes": ("a.ply", partial(changed_bytes, files.ply_binary())),
    "PLY, words": ("a.ply", partial(changed_words, files.PLY)),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Iterator[Path]:
    """Good files, and a process that can have one more gigabyte, not two."""
    folder = tmp_path_factory.mktemp("fuzz")
    files.obj()(folder)
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (1 << 30), hard))
    yield folder
    resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


@pytest.mark.parametrize("kind", KINDS)
def test_a_mutated_file_is_read_or_refused_in_one_line(folder, kind):
    """And mutations are neither harmless nor hopeless: some of each kind are read, some are refused."""
    name, changed = KINDS[kind]
    read = refused = 0

    @settings(max_examples=CASES, deadline=None, database=None, suppress_health_check=list(HealthCheck))
    @given(seed=st.integers(0, 2**32 - 1))
    def one(seed: int) -> None:
        nonlocal read, refused
        files.obj()(folder)
        (folder / name).write_bytes(changed(Random(seed)))
        start = time.process_time()
        try:
            read_asset(folder / ("a.obj" if name == "m.mtl" else name))
            read += 1
        except ValueError as refusal:
            refused += 1
            assert "\n" not in str(refusal) and str(folder) in str(refusal)
            assert "cannot be read" not in str(refusal), "no fault is left to the parsers' own words"
        assert time.process_time() - start < 5

    one()
    print(kind, read, refused)
    assert read > 0 and (refused > CASES / 20 or kind == "MTL, words")
