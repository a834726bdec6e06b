"""The command line, from a file to new textures: `experiments/smoke.py` run as a user runs it."""

import contextlib
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from helpers.files import obj
from PIL import Image

from flx.assets.asset import own_painting
from flx.assets.vase import vase_asset
from flx.assets.write import write
from flx.config import quick
from flx.launch import command, keep_compiled_programs, main, use_large_pages
from flx.machine import Memory
from flx.training.run import Run

ROOT = Path(__file__).parent.parent
SMOKE = str(ROOT / "experiments" / "smoke.py")


def flx(*arguments: str, cwd: Path, status: int = 0) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "flx.launch", *arguments]
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=400)
    assert done.returncode == status, done.stderr
    return done


def here(*arguments: str, cwd: Path) -> str:
    """What is said on stdout in this process, which loads JAX and traces programs once for all calls."""
    said = io.StringIO()
    with contextlib.chdir(cwd), contextlib.redirect_stdout(said):
        assert main(list(arguments)) == 0
    return said.getvalue()


@pytest.fixture(scope="module")
def vase(tmp_path_factory) -> Path:
    """A folder with the vase."""
    folder = tmp_path_factory.mktemp("flx")
    write(asset := vase_asset(), own_painting(asset), folder / "vase.glb")
    return folder


def test_a_name_that_the_output_cannot_spell_is_no_error(tmp_path):
    """As where a report is sent to a file on a system whose letters are others than the mesh's."""
    folder = tmp_path / "ünï 日本 dir"
    folder.mkdir()
    folder = obj()(folder).rename(folder / "kula 日本.obj").parent
    command = [sys.executable, "-m", "flx.launch", "doctor", "kula 日本.obj"]
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "kula \\u65e5\\u672c.obj" in done.stdout


@pytest.mark.parametrize(
    ("verb", "work", "said"),
    [
        ("train", lambda: jnp.zeros(1 << 47), "for 562949953421312 bytes; use fewer --surface.vertices"),
        ("sample", lambda: np.zeros(1 << 57), "for 1.00 EiB; use a smaller --texture-size"),
        ("bench", lambda: 1 * [0] * (1 << 60), "; close other programs"),
    ],
)
def test_a_lack_of_memory_is_one_line_with_what_takes_less(monkeypatch, capsys, verb, work, said):
    monkeypatch.setattr("flx.launch.parse", lambda _: work)
    assert main([verb]) == 1
    line = capsys.readouterr().err
    assert line.startswith("flx: there is not enough memory") and said in line and line.count("\n") == 1


def test_a_fault_of_flx_itself_keeps_its_traceback(monkeypatch):
    def faulty() -> None:
        raise RuntimeError("not foreseen")

    monkeypatch.setattr("flx.launch.parse", lambda _: faulty)
    with pytest.raises(RuntimeError, match="not foreseen"):
        main(["bench"])


@pytest.fixture(scope="module")
def trained(vase) -> Path:
    """Beside it, a run of the smoke experiment that was killed and called again."""
    folder = vase
    arguments = ["train", SMOKE, "--surface.path", "vase.glb", "--name", "smoke"]
    killed = subprocess.Popen([sys.executable, "-m", "flx.launch", *arguments], cwd=folder)
    first = folder / "runs" / "smoke" / "checkpoints" / "10"
    while not first.exists() and killed.poll() is None:
        time.sleep(0.05)
    os.kill(killed.pid, signal.SIGKILL)
    killed.wait()
    assert killed.returncode == -signal.SIGKILL and first.exists()
    again = flx(*arguments, cwd=folder)
    assert "resumed at step" in again.stderr
    return folder


@pytest.fixture(scope="module")
def sampled(trained: Path) -> Path:
    here("sample", "runs/smoke", "--count", "2", "--steps", "4", "--texture-size", "256", cwd=trained)
    return trained / "runs" / "smoke" / "samples-texture-size-256-steps-4"


@pytest.mark.slow
def test_metrics_have_each_step_once(trained):
    rows = (trained / "runs" / "smoke" / "metrics.csv").read_text().splitlines()[1:]
    assert [int(row.split(",")[0]) for row in rows] == [10, 20, 30]


@pytest.mark.slow
def test_variations_keep_the_mesh_and_change_its_texture(trained, sampled):
    """Loaded by trimesh, not by flx: same positions, faces and coordinates; only the picture differs."""
    before = trimesh.load_mesh(trained / "vase.glb", process=False)
    texture = np.asarray(before.visual.material.baseColorTexture.convert("RGB").resize((256, 256)), float)
    seen = [texture]
    for n in range(2):
        after = trimesh.load_mesh(sampled / f"variation_{n:02d}.glb", process=False)
        np.testing.assert_array_equal(after.vertices, before.vertices)
        np.testing.assert_array_equal(after.faces, before.faces)
        np.testing.assert_array_equal(after.visual.uv, before.visual.uv)
        picture = after.visual.material.baseColorTexture
        assert picture.size == (256, 256)
        np.testing.assert_array_equal(np.asarray(picture), Image.open(sampled / f"variation_{n:02d}.png"))
        assert all(np.abs(np.asarray(picture, float) - other).mean() > 3 for other in seen)
        seen.append(np.asarray(picture, float))
    assert Image.open(sampled / "contact_sheet.png").width > 3 * 300


@pytest.mark.slow
def test_the_same_seed_gives_the_same_files_after_a_kill(trained, sampled):
    wanted = {path.name: path.read_bytes() for path in sampled.iterdir()}
    arguments = [
        "sample",
        "runs/smoke",
        "--count",
        "2",
        "--steps",
        "4",
        "--texture-size",
        "256",
        "--out",
        "again",
    ]
    killed = subprocess.Popen([sys.executable, "-m", "flx.launch", *arguments], cwd=trained)
    while not (trained / "again" / "variation_00.glb").exists() and killed.poll() is None:
        time.sleep(0.02)
    killed.kill()
    killed.wait()
    left = [p for p in (trained / "again").glob("[!.]*") if p.suffix != ".json"]  # that lists less so far
    assert left and all(path.read_bytes() == wanted[path.name] for path in left)
    here(*arguments, cwd=trained)
    for name, content in wanted.items():
        assert (trained / "again" / name).read_bytes() == content


@pytest.mark.slow
def test_another_asset_under_the_same_name_is_refused(trained, monkeypatch, capsys):
    monkeypatch.chdir(trained)
    said = refusal(["train", SMOKE], capsys)
    assert said.count("\n") == 1 and "--name" in said


@pytest.mark.slow
def test_reconstruct_measures_what_it_writes(vase):
    arguments = ["vase.glb", "--vertices", "1500", "--texture-size", "256", "--out", "back"]
    metrics = json.loads(here("reconstruct", *arguments, cwd=vase))
    assert json.loads((vase / "back" / "metrics.json").read_text()) == metrics
    assert 17 < metrics["psnr"] < 40 and 0 < metrics["dssim"] < 0.4 and metrics["peak_bytes"] > 1e8
    for name in ("reconstruction.glb", "reconstruction.png", "side_by_side.png"):
        assert (vase / "back" / name).stat().st_size > 10_000


def test_doctor_reports_in_words_and_in_json(vase, capsys):
    assert "vertices" in flx("doctor", "vase.glb", cwd=vase).stdout
    assert main(["doctor", str(vase / "vase.glb"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["components"] == 1


# --- refusals: in this process but for two, for each process starts JAX anew


def refusal(arguments: list[str], capsys) -> str:
    """What is said on stderr, where the exit status is 2."""
    try:
        status = main(arguments)
    except SystemExit as end:  # tyro's, on words that it does not know
        status = end.code
    said = capsys.readouterr()
    assert status == 2 and not said.out
    return said.err


@pytest.mark.parametrize(
    "arguments",
    [["doctor", "missing.glb"], pytest.param(["sample", "runs/none"], marks=pytest.mark.slow)],
)
def test_a_refusal_is_one_line_of_a_process_too(vase, arguments):
    done = flx(*arguments, cwd=vase, status=2)
    assert done.stderr.count("\n") == 1 and arguments[1] in done.stderr and not done.stdout


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["doctor", "missing.glb"], "missing.glb"),
        (["train", "missing.py"], "missing.py"),
        (["sample", "runs/none"], "runs/none"),
        (["frobnicate"], "frobnicate"),
        (["reconstruct", "vase.glb", "--weights", "vase.glb"], "vase.glb"),
        (["reconstruct", "vase.glb", "--texture-size", "4"], "--texture-size is 4"),
        (["reconstruct", "vase.glb", "--texture-size", "30000"], "--texture-size is 30000"),
        (["reconstruct", "vase.glb", "--out", "vase.glb"], "vase.glb is a file"),
        (["reconstruct", "vase.glb", "--out", "vase.glb/deeper"], "vase.glb is a file"),
        (["bench", "vase.glb"], "--mesh"),
    ],
)
def test_wrong_input_is_one_line_and_status_2(vase, monkeypatch, capsys, arguments, named):
    monkeypatch.chdir(vase)
    said = refusal(arguments, capsys)
    assert said.count("\n") == 1 and named in said


@pytest.mark.slow
def test_a_mask_that_does_not_fit_is_refused_and_nothing_is_written(trained, monkeypatch, capsys):
    monkeypatch.chdir(trained)
    Image.new("L", (30, 20)).save("small.png")
    (trained / "words.png").write_text("no image")
    for mask, named in (("small.png", "30 × 20"), ("words.png", "no known kind"), ("none.png", "not exist")):
        said = refusal(["sample", "runs/smoke", "--keep", mask, "--out", "kept"], capsys)
        assert said.count("\n") == 1 and named in said and mask in said
    said = refusal(["sample", "runs/smoke", "--keep", "small.png", "--fill", "small.png"], capsys)
    assert "give one" in said and not (trained / "kept").exists()


@pytest.mark.slow
def test_no_variations_are_refused(trained, monkeypatch, capsys):
    monkeypatch.chdir(trained)
    said = refusal(["sample", "runs/smoke", "--count", "0"], capsys)
    assert said.count("\n") == 1 and "--count is 0; give at least 1" in said


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("--train.steps", "0"),
        ("--train.batch", "0"),
        ("--train.ema", "1"),
        ("--surface.copies", "0"),
        ("--workers", "0"),
    ],
)
def test_a_number_out_of_its_range_is_refused_before_anything_is_made(
    tmp_path, monkeypatch, capsys, field, value
):
    monkeypatch.chdir(tmp_path)
    said = refusal(["train", SMOKE, "--name", "wrong", field, value], capsys)
    place = field[2:] if "." in field else field
    assert said.count("\n") == 1 and said.startswith(f"flx: {place} is {value}") and "; give" in said
    assert not (tmp_path / "runs" / "wrong").exists()


@pytest.mark.parametrize(
    ("field", "told"),
    [("vertices", "a copy of 100,000,000 vertices"), ("copies", "100,000,000 copies of 800 vertices")],
)
def test_what_cannot_fit_into_memory_is_refused_at_once(tmp_path, monkeypatch, capsys, field, told):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("flx.geometry.copies.memory", lambda: Memory(16e9, 8e9))
    said = refusal(["train", SMOKE, f"--surface.{field}", "100000000"], capsys)
    assert said.count("\n") == 1 and told in said and "this machine has 16 GB; give at most" in said
    assert not list(tmp_path.iterdir())


def test_it_is_refused_before_jax_is_loaded(tmp_path):
    """JAX takes seconds."""
    words = ["train", SMOKE, "--surface.vertices", "1000000000000"]
    code = f"import sys; from flx.launch import main; print(main({words}), 'jax' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout.strip() == "2 False" and done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["train", SMOKE, "--train.stepz", "3"], "no option --train.stepz; --train.steps is the nearest one"),
        (["sample", "--cuont", "3"], "there is no option --cuont; --count is the nearest one"),
        (["sample", "--instnat"], "there is no option --instnat; --instant is the nearest one"),
        (["sample", "--count", "0"], "--count is 0; give at least 1"),
        (["sample", "--bogus=3"], "no option --bogus; `flx sample --help-all` lists what there is"),
        (["sample", "a", "b"], "'b' is one word too many; `flx sample --help-all` lists what there is"),
        (["doctor"], "doctor needs PATH: a .glb, .gltf, .obj or .ply file"),
        (["sample", "--count"], "--count needs a value; `flx sample --help-all` lists what there is"),
        (["sample", "--count", "x"], "--count is 'x'; give a whole number"),
        (["sample", "--scale", "x y"], "--scale is 'x y'; give a number"),
        (["sample", "--format", "gltf"], "--format is 'gltf'; choose one of glb, obj, ply"),
    ],
)
def test_what_the_command_line_refuses_is_one_line_in_its_words(tmp_path, monkeypatch, capsys, words, told):
    monkeypatch.chdir(tmp_path)
    said = refusal(words, capsys)
    assert said.startswith("flx: ") and said.endswith(f"{told}\n") and said.count("\n") == 1


@pytest.mark.slow
def test_the_generator_alone_samples_the_same_files(trained, sampled, tmp_path):
    """Neither the run folder nor the mesh is needed: the one file in an empty folder."""
    content = (trained / "runs" / "smoke" / "generator.safetensors").read_bytes()
    (tmp_path / "vase.safetensors").write_bytes(content)
    arguments = ["vase.safetensors", "--count", "1", "--steps", "4", "--texture-size", "256"]
    assert here("sample", *arguments, cwd=tmp_path).strip() == "samples-texture-size-256-steps-4"
    for name in ("variation_00.glb", "variation_00.png"):
        assert (tmp_path / "samples-texture-size-256-steps-4" / name).read_bytes() == (
            sampled / name
        ).read_bytes()


@pytest.mark.slow
def test_a_run_of_an_earlier_version_samples_the_same_and_goes_on(trained, sampled, tmp_path):
    """It has no generator file, and its config says what the model then was thought to be."""
    run = tmp_path / "runs" / "smoke"
    shutil.copytree(trained / "runs" / "smoke", run, ignore=shutil.ignore_patterns("samples*", "generator*"))
    record = json.loads((run / "config.json").read_bytes())
    del record["flx"]
    record["config"]["model"] |= {"latents": 8, "invariants": 0, "blocks": None}
    (run / "config.json").write_text(json.dumps(record))
    words = ["sample", "runs/smoke", "--count", "1", "--steps", "4", "--texture-size", "256", "--out", "a"]
    here(*words, cwd=tmp_path)
    assert (tmp_path / "a" / "variation_00.glb").read_bytes() == (sampled / "variation_00.glb").read_bytes()
    shutil.copy(trained / "vase.glb", tmp_path)
    here("train", SMOKE, "--surface.path", "vase.glb", "--name", "smoke", cwd=tmp_path)
    new = (run / "generator.safetensors").read_bytes()
    assert new == (trained / "runs" / "smoke" / "generator.safetensors").read_bytes()
    assert json.loads((run / "config.json").read_bytes())["config"]["model"]["invariants"] == 3


def test_a_mesh_needs_no_config(vase, monkeypatch, capsys):
    """The demo's settings, the run named after the file; every field is an option all the same."""
    learnt = []

    def learn(experiment, root=Path("runs"), workers=None, **_):
        learnt.append((experiment, workers))
        return Run(root / experiment.name)

    monkeypatch.chdir(vase)
    monkeypatch.setattr("flx.commands.train.learn", learn)
    assert main(["train", "vase.glb", "--surface.vertices", "300", "--workers", "2"]) == 0
    wanted = quick("vase.glb", "vase")
    assert learnt == [(replace(wanted, surface=replace(wanted.surface, vertices=300)), 2)]
    said = capsys.readouterr()
    assert said.out == "runs/vase\n" and "flx sample runs/vase" in said.err


@pytest.mark.parametrize("place", ["", "a file", "a file/below"])
def test_a_run_goes_on_where_compiled_programs_cannot_be_kept(place, monkeypatch, tmp_path):
    (tmp_path / "a file").touch()
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setenv("FLX_CACHE", place and str(tmp_path / place))
    keep_compiled_programs()
    assert "JAX_COMPILATION_CACHE_DIR" not in os.environ


def test_compiled_programs_are_kept_and_a_damaged_one_is_compiled_again_in_silence(tmp_path):
    script = """
from pathlib import Path
from flx.config import quick
from flx.launch import keep_compiled_programs
keep_compiled_programs()
import jax

def double():
    jax.clear_caches()
    return float(jax.jit(lambda x: 2 * x)(1.0))

first = double()
kept = list(Path(jax.config.jax_compilation_cache_dir).glob("*-cache"))
for file in kept:
    file.write_bytes(file.read_bytes()[:-7])
print(len(kept) > 0, first, double())
"""
    free = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    free |= {"FLX_CACHE": str(tmp_path / "kept"), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, env=free, cwd=ROOT, capture_output=True, text=True, timeout=200)
    assert (done.stdout.split(), done.stderr) == (["True", "2.0", "2.0"], "")
    (programs,) = (tmp_path / "kept").iterdir()
    assert programs.stat().st_mode & 0o077 == 0  # whoever can write here runs code


def test_the_launcher_starts_again_with_large_pages_unless_the_user_chose(monkeypatch):
    started = []
    monkeypatch.setattr("platform.libc_ver", lambda: ("glibc", "2.36"))
    monkeypatch.setattr(os, "execv", lambda path, words: started.append((path, words)))
    monkeypatch.delenv("GLIBC_TUNABLES", raising=False)
    monkeypatch.setattr(sys, "orig_argv", ["python", "-m", "flx.launch", "train"])
    use_large_pages()
    assert started == [(sys.executable, [sys.executable, "-m", "flx.launch", "train"])]
    assert "glibc.malloc.hugetlb=1" in os.environ["GLIBC_TUNABLES"]
    use_large_pages()  # the process that was started
    monkeypatch.delenv("GLIBC_TUNABLES")
    monkeypatch.setattr("platform.libc_ver", lambda: ("", ""))  # another C library
    use_large_pages()
    assert len(started) == 1


@pytest.mark.parametrize(("words", "started"), [(["sample", "--instant"], 0), (["sample", "runs/x"], 1)])
def test_what_runs_no_network_does_without_large_pages(words, started, monkeypatch):
    """They keep all memory that was ever used: twice what a patchwork needs."""
    calls = []
    monkeypatch.setattr(sys, "argv", ["flx", *words])
    monkeypatch.setattr("flx.launch.use_large_pages", lambda: calls.append(1))
    monkeypatch.setattr("flx.launch.main", lambda: 0)
    assert command() == 0 and len(calls) == started
