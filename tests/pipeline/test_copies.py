"""Laws of prepared copies on disk: whole or not there, made once, and never mixed with another's."""

import os
import signal
import subprocess
import sys
import time
import zipfile
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from helpers.codecs import TINY
from helpers.files import colored_ball
from helpers.surfaces import bump, icosphere
from helpers.tables import SLOTS, assert_same_tables
from hypothesis import given, settings
from hypothesis import strategies as st

from flx.assets.asset import Asset
from flx.assets.read import read_asset
from flx.config import Surface
from flx.geometry.copies import make_copy
from flx.geometry.tables import mesh_tables
from flx.pipeline import copies
from flx.pipeline.codec import Codec, initial_params
from flx.pipeline.copies import Cache, Prepared, load_tables, open_cache, prepare, save_tables

pytestmark = pytest.mark.slow

SURFACE = Surface(vertices=100, copies=2, seed=7)

# --- the cache


@pytest.fixture(scope="module")
def asset(tmp_path_factory) -> Asset:
    return read_asset(colored_ball(tmp_path_factory.mktemp("ball")))


@pytest.fixture(scope="module")
def codec() -> Codec:
    return Codec(TINY, initial_params(TINY, 0))


@pytest.fixture(scope="module")
def made(tmp_path_factory, asset, codec) -> Cache:
    """Two copies, made without interruption."""
    cache = open_cache(tmp_path_factory.mktemp("made"), asset, SURFACE, codec)
    prepare(cache, asset, SURFACE, codec)
    return cache


def files(cache: Cache) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(cache.folder.iterdir())}


def assert_same(a: Prepared, b: Prepared) -> None:
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


def test_a_copy_is_the_one_of_its_seed_and_its_latents_are_of_its_rings(made, asset, codec):
    for seed in (7, 8):
        copy = make_copy(asset.mesh, SURFACE.vertices, TINY.samples, SURFACE.slots, seed)
        loaded = made.load(seed)
        np.testing.assert_array_equal(loaded.triangulation.vertices, copy.triangulation.vertices)
        np.testing.assert_array_equal(loaded.triangulation.faces, copy.triangulation.faces)
        assert_same_tables(loaded.tables, copy.tables)
        np.testing.assert_array_equal(loaded.latents, codec.encode(copy.rings))
    assert not np.array_equal(made.load(7).triangulation.vertices, made.load(8).triangulation.vertices)
    assert not made.has(6) and not made.has(9)


def test_what_is_there_is_not_made_again_and_what_is_missing_is_added(tmp_path, made, asset, codec):
    cache = Cache(tmp_path, made.key)
    for name, content in files(made).items():
        (tmp_path / name).write_bytes(content)
    times = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    prepare(cache, asset, SURFACE, codec)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == times
    prepare(cache, asset, replace(SURFACE, copies=3), codec)
    assert {path: path.stat().st_mtime_ns for path in times} == times
    assert cache.has(9) and len(cache.load(9).latents) == SURFACE.vertices


@pytest.mark.parametrize("left", ["arrays", "tables", "torn"])
def test_a_copy_of_which_a_part_is_missing_is_made_again(tmp_path, made, asset, codec, left):
    """Saved in two files: a kill in between leaves one of them, or a torn one under a hidden name."""
    cache, wanted = Cache(tmp_path, made.key), files(made)
    tables = [name for name in wanted if ".tables" in name]
    kept = tables if left == "tables" else [name for name in wanted if name not in tables]
    for name in kept:
        (tmp_path / (f".99.{name}" if left == "torn" else name)).write_bytes(
            wanted[name][: -50 if left == "torn" else None]
        )
    assert not cache.has(7) and not cache.has(8)
    prepare(cache, asset, SURFACE, codec)
    for seed in (7, 8):
        assert_same(cache.load(seed), made.load(seed))


@pytest.mark.skipif(os.name != "posix", reason="it kills a group of processes, which only POSIX has")
def test_a_preparation_that_was_killed_goes_on_where_it_was(tmp_path, asset, codec):
    """`kill -9` after the first copy is there: what is there stays, and the rest is the same as ever."""
    surface = replace(SURFACE, copies=40)
    script = (
        "import sys; from dataclasses import replace; from pathlib import Path\n"
        "from helpers.codecs import TINY; from helpers.files import colored_ball\n"
        "from flx.assets.read import read_asset; from flx.config import Surface\n"
        "from flx.pipeline.codec import Codec, initial_params\n"
        "from flx.pipeline.copies import open_cache, prepare\n"
        "if __name__ == '__main__':\n"
        "    folder, codec = Path(sys.argv[1]), Codec(TINY, initial_params(TINY, 0))\n"
        "    asset, surface = read_asset(colored_ball(folder)), Surface(vertices=100, copies=40, seed=7)\n"
        "    prepare(open_cache(folder / 'cache', asset, surface, codec), asset, surface, codec)\n"
    )
    cache = open_cache(tmp_path / "cache", asset, surface, codec)
    child = subprocess.Popen(
        [sys.executable, "-c", script, str(tmp_path)],  # -c: modules are looked for where it starts
        cwd=Path(__file__).parents[1],
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    deadline = time.monotonic() + 120
    while not any(map(cache.has, range(7, 47))):
        assert child.poll() is None and time.monotonic() < deadline
        time.sleep(0.005)
    os.killpg(child.pid, signal.SIGKILL)  # and the processes of its pool
    assert child.wait() == -signal.SIGKILL
    there = [seed for seed in range(7, 47) if cache.has(seed)]
    assert 0 < len(there) < 40
    times = {seed: cache.path(seed).stat().st_mtime_ns for seed in there}
    first = there[0]
    again = replace(surface, copies=max(there) - 7 + 2)  # with one that was not there
    prepare(cache, asset, again, codec)
    assert times == {seed: cache.path(seed).stat().st_mtime_ns for seed in there}
    assert all(map(cache.has, range(7, 7 + again.copies)))
    copy = make_copy(asset.mesh, 100, TINY.samples, SURFACE.slots, first)
    assert_same(cache.load(first), Prepared(copy.triangulation, copy.tables, codec.encode(copy.rings)))


@pytest.mark.parametrize("damage", ["empty", "cut", "foreign", "flipped"])
@pytest.mark.parametrize("part", ["arrays", "tables"])
def test_a_damaged_copy_is_made_again_and_said(tmp_path, made, asset, codec, part, damage, capsys):
    cache = Cache(tmp_path, made.key)
    for name, content in files(made).items():
        (tmp_path / name).write_bytes(content)
    path = cache.path(7) if part == "arrays" else cache.path(7).with_suffix(".tables.npz")
    content = path.read_bytes()
    match damage:
        case "empty":
            path.write_bytes(b"")
        case "cut":
            path.write_bytes(content[: len(content) // 2])
        case "foreign":
            np.savez(path, other=np.zeros(3))
        case "flipped":
            path.write_bytes(content[:400] + bytes([content[400] ^ 1]) + content[401:])
    with pytest.raises(ValueError, match=path.name.replace(".", r"\.")) as refusal:
        cache.load(7)
    assert "\n" not in str(refusal.value)
    untouched = cache.path(8).stat().st_mtime_ns
    for copy, seed in zip(prepare(cache, asset, SURFACE, codec), (7, 8), strict=True):
        assert_same(copy, made.load(seed))
        assert_same(cache.load(seed), made.load(seed))
    said = [line for line in capsys.readouterr().err.splitlines() if "again" in line]
    assert len(said) == 1 and path.name in said[0] and cache.path(8).stat().st_mtime_ns == untouched


@given(data=st.data())
@settings(max_examples=100)
def test_a_flipped_bit_of_a_copy_is_never_loaded(tmp_path_factory, made, data):
    cache = Cache(tmp_path_factory.mktemp("flipped"), made.key)
    for name, content in files(made).items():
        (cache.folder / name).write_bytes(content)
    path = cache.path(7)
    content = bytearray(path.read_bytes())
    content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(content)
    if (copy := cache.find(7)) is not None:  # a time, say: of the archive, not of what it holds
        assert_same(copy, made.load(7))


@pytest.mark.parametrize("kind", [ChildProcessError, MemoryError])
def test_where_memory_runs_out_the_copies_so_far_are_kept_and_counted(
    tmp_path, monkeypatch, asset, codec, made, kind
):
    def dying(function, shared, tasks, workers):
        yield 0, function(*shared, *tasks[0])
        raise kind("a worker died")

    monkeypatch.setattr(copies, "in_processes", dying)
    cache = open_cache(tmp_path, asset, SURFACE, codec)
    with pytest.raises(kind) as death:
        prepare(cache, asset, SURFACE, codec, workers=2)
    told = f"a worker died; 1 of 2 copies are kept in {tmp_path}; the same command makes the rest"
    assert str(death.value) == f"{told}, and --workers 1 needs the least memory"
    assert_same(cache.load(7), made.load(7))


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the system does not tell the peak")
def test_a_copy_takes_about_as_much_memory_as_is_estimated():
    """In a process of its own."""
    script = (
        "from pathlib import Path; from flx.assets.vase import vase_asset\n"
        "from flx.geometry.copies import make_copy, memory_to_make\n"
        "make_copy(mesh := vase_asset().mesh, 3000, 64, 16, 0)\n"
        "peak = 1024 * int(Path('/proc/self/status').read_text().split('VmHWM:')[1].split()[0])\n"
        "print(peak / memory_to_make(3000, mesh))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert 0.4 < float(done.stdout) < 1.5


def test_copies_are_kept_apart_by_all_that_they_hang_on(tmp_path, asset, codec, made):
    other = read_asset(colored_ball(tmp_path))
    same = open_cache(tmp_path, other, replace(SURFACE, copies=50, seed=3, path="elsewhere.ply"), codec)
    assert same.key == made.key  # of the same contents; seeds have files of their own
    keys = {made.key}
    for surface in (replace(SURFACE, vertices=101), replace(SURFACE, slots=20)):
        keys.add(open_cache(tmp_path, asset, surface, codec).key)
    keys.add(open_cache(tmp_path, asset, SURFACE, Codec(TINY, initial_params(TINY, 1))).key)
    keys.add(open_cache(tmp_path, asset._replace(digest="another"), SURFACE, codec).key)
    assert len(keys) == 5


# --- tables


def test_tables_survive_the_disk_bit_for_bit(tmp_path):
    tables = mesh_tables(bump(0), SLOTS)
    save_tables(tmp_path / "copy.npz", tables)
    assert_same_tables(load_tables(tmp_path / "copy.npz"), tables)
    assert [path.name for path in tmp_path.iterdir()] == ["copy.npz"]


def test_interrupted_save_leaves_the_old_file(tmp_path, monkeypatch):
    old, new = mesh_tables(bump(0), SLOTS), mesh_tables(bump(1), SLOTS)
    save_tables(tmp_path / "copy.npz", old)

    def interrupted(file, **arrays):
        Path(file).write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez", interrupted)
    with pytest.raises(KeyboardInterrupt):
        save_tables(tmp_path / "copy.npz", new)
    assert_same_tables(load_tables(tmp_path / "copy.npz"), old)
    assert [path.name for path in tmp_path.iterdir()] == ["copy.npz"]


def test_file_that_holds_no_tables_is_refused(tmp_path):
    path = tmp_path / "copy.npz"
    save_tables(path, mesh_tables(bump(0), SLOTS))
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(ValueError, match="holds no mesh tables"):
        load_tables(path)
    np.savez(path, other=np.zeros(3))
    with pytest.raises(ValueError, match=r"holds no mesh tables.*fine\.neighbors"):
        load_tables(path)
    np.savez(path, **{"fine.neighbors": np.array([{"a": 1}], dtype=object)})
    with pytest.raises(ValueError, match=r"holds no mesh tables.*pickle"):
        load_tables(path)


class Trap:
    """Writes a file when it is unpickled."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self):
        return Path.write_text, (self.path, "executed")


def test_a_pickle_in_the_place_of_tables_is_not_executed(tmp_path):
    path, mark = tmp_path / "tables.npz", tmp_path / "mark"
    np.savez(path, **dict.fromkeys(_names(tmp_path), np.array([Trap(mark)], object)))
    with pytest.raises(ValueError, match="allow_pickle"):
        load_tables(path)
    assert not mark.exists()
    with np.load(path, allow_pickle=True) as trap:  # the trap works
        assert all(trap[name] is not None for name in trap.files)
    assert mark.exists()


def _names(folder: Path) -> list[str]:
    """What a file of tables holds."""
    save_tables(folder / "good.npz", mesh_tables(icosphere(1)))
    return [Path(name).stem for name in zipfile.ZipFile(folder / "good.npz").namelist()]
