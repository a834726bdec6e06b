"""Laws of the doctor: what it counts is what was put in, and what it foresees follows from the surface."""

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.files import MTL, OBJ, at, obj, png
from helpers.surfaces import random_sphere
from PIL import Image

from flx.assets.asset import Asset
from flx.assets.read import read_asset
from flx.commands.doctor import Findings, describe, examine
from flx.config import FLDM, FLDMExperiment, Surface, Train
from flx.launch import main
from flx.machine import Memory
from flx.models.denoiser.depth import blocks_for
from flx.training.costs import costs_of
from flx.training.run import Run

PLAN = FLDMExperiment(surface=Surface(vertices=5000, copies=8), train=Train(steps=100, batch=1))


def save(folder: Path, points: np.ndarray, uvs: np.ndarray, faces: np.ndarray, size=(64, 64)) -> Asset:
    """An OBJ whose corners are rows of both arrays."""
    Image.new("RGB", size, (9, 9, 9)).save(folder / "a.png")
    (folder / "m.mtl").write_text("newmtl skin\nmap_Kd a.png\n")
    lines = ["mtllib m.mtl", *(f"v {x} {y} {z}" for x, y, z in points), *(f"vt {u} {v}" for u, v in uvs)]
    lines += ["usemtl skin", *("f " + " ".join(f"{i + 1}/{i + 1}" for i in face) for face in faces)]
    (folder / "a.obj").write_text("\n".join(lines))
    return read_asset(folder / "a.obj")


def square(folder: Path, shift: float = 0.0, scale: float = 0.5, polygon: bool = False) -> Asset:
    """Two unit squares side by side; the second one's place on the texture is `shift` further right."""
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    uvs = points[:, :2] * scale
    points = np.concatenate([points, points + np.array([5, 0, 0])])
    uvs = np.concatenate([uvs, uvs + np.array([shift, 0])])
    faces = [[0, 1, 2, 3], [4, 5, 6, 7]] if polygon else [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]
    return save(folder, points, uvs, np.array(faces))


def examined(asset: Asset, plan: FLDMExperiment = PLAN) -> Findings:
    return examine(asset, plan)


@pytest.mark.parametrize(
    "shift, covered, overlapping", [(0.5, 0.5, 0.0), (0.25, 0.375, 1 / 3), (0, 0.25, 1), (1, 0.25, 1)]
)
def test_texels_shown_twice_are_counted_also_across_repetitions(tmp_path, shift, covered, overlapping):
    findings = examined(square(tmp_path, shift))
    assert findings.covered_texels == pytest.approx(covered, abs=0.02)
    assert findings.overlapping_texels == pytest.approx(overlapping, abs=0.02)
    assert any("more than once" in text for text in findings.warnings) == (overlapping > 0)


def test_pixels_in_a_one_ring_are_three_shares_of_those_the_surface_has(tmp_path):
    asset = square(tmp_path, 0.5)
    pixels = 64 * 64 * 0.5
    assert examined(asset).ring_pixels == pytest.approx([3 * pixels / 5000] * 3)
    few = FLDMExperiment(surface=Surface(vertices=500))
    assert examined(asset, few).ring_pixels == pytest.approx([3 * pixels / 500] * 3)
    assert any("fewer vertices" in text for text in examined(asset).warnings)


def test_polygons_are_cut_and_counted(tmp_path):
    whole, cut = square(tmp_path, 0.5, polygon=True), square(tmp_path, 0.5)
    assert (whole.report.polygons, cut.report.polygons) == (2, 0)
    assert np.array_equal(whole.mesh.faces, cut.mesh.faces) and whole.digest == cut.digest
    assert "polygons cut" in describe(whole.report) and "polygons cut" not in describe(cut.report)


@pytest.mark.parametrize("turned, opened", [(False, False), (True, False), (True, True)])
def test_closed_components_that_look_inwards_are_counted(tmp_path, turned, opened):
    points, faces = random_sphere(40)
    both = np.concatenate([points + np.array([100, 0, 0]), points - [0, 50, 0]])  # far from the origin
    second = (faces[:, ::-1] if turned else faces)[opened:]
    uvs = (both[:, :2] - both[:, :2].min(0)) / 200
    findings = examined(save(tmp_path, both, uvs, np.concatenate([faces, second + len(points)])))
    assert findings.inside_out_components == int(turned and not opened)


def test_the_verdict_tells_repairs_and_warnings(tmp_path):
    assert examined(square(tmp_path, 0.5, scale=0.99)).verdict.startswith("flx takes it (as it is)")
    points, faces = random_sphere(40)
    three = np.concatenate([faces, [[faces[0, 0], faces[0, 1], len(points)]], faces[1:2]])
    asset = save(
        tmp_path, np.vstack([points, 2 * points[:1]]), np.vstack([points, points[:1]])[:, :2] / 4, three
    )
    report, findings = asset.report, examined(asset)
    assert (report.duplicate_faces, report.nonmanifold_edges) == (1, 1) and report.nonmanifold_vertices >= 1
    cut = report.nonmanifold_edges + report.nonmanifold_vertices
    assert f"1 faces dropped, {cut} edges and vertices cut" in findings.verdict
    assert describe(report, findings).splitlines()[-1].endswith(findings.verdict)


def test_the_estimate_grows_with_what_a_run_is_made_of(tmp_path):
    asset = square(tmp_path, 0.5)
    plan = examined(asset).plan
    more = FLDMExperiment(
        model=FLDM(channels=192), surface=Surface(vertices=5000, copies=16), train=Train(steps=200, batch=1)
    )
    twice = examined(asset, more).plan
    assert twice.copy_seconds == 2 * plan.copy_seconds and twice.disk_bytes == 2 * plan.disk_bytes
    assert twice.train_seconds == 4 * plan.train_seconds and twice.step_seconds == 2 * plan.step_seconds
    assert twice.train_bytes > plan.train_bytes
    parts = replace(more, train=Train(steps=200, batch=2, accumulate=2))
    assert examined(asset, parts).plan.train_bytes == twice.train_bytes


@pytest.mark.parametrize("vertices", [100, 1000, 2500, 5000, 10_000, 20_000, 30_000])
def test_the_network_that_is_estimated_is_the_one_that_is_trained(tmp_path, vertices):
    asset, blocks = square(tmp_path, 0.5), blocks_for(vertices)
    surface = Surface(vertices=vertices, copies=8)
    found, asked = (
        examined(asset, FLDMExperiment(surface=surface, model=FLDM(blocks=b))).plan for b in (None, blocks)
    )
    assert found.train_seconds == asked.train_seconds and found.train_bytes == asked.train_bytes
    shallow = examined(asset, FLDMExperiment(surface=surface, model=FLDM(blocks=(1, 1, 1)))).plan
    assert shallow.train_seconds == pytest.approx(3 * found.train_seconds / sum(blocks))


def test_the_command_prints_everything_as_json(tmp_path, capsys):
    path = obj()(tmp_path)
    assert main(["doctor", str(path), "--vertices", "4000", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["components"] == 1 and found["plan"]["vertices"] == 4000
    assert found["verdict"].startswith("flx takes it") and "overlapping_texels" in found
    assert main(["doctor", str(path)]) == 0
    assert "verdict" in capsys.readouterr().out.splitlines()[-1]


def test_a_refusal_is_a_verdict_too(tmp_path, capsys):
    path = obj(lambda text: text.replace("v 1 0 0", "v nan 0 0"))(tmp_path)
    assert main(["doctor", str(path), "--json"]) == 2
    said = capsys.readouterr()
    assert json.loads(said.out)["verdict"].startswith("refused: ") and said.err.count("\n") == 1
    assert main(["doctor", str(obj()(tmp_path)), "--vertices", "3"]) == 2
    assert "surface.vertices is 3" in capsys.readouterr().err


def test_limits_can_be_raised_and_are_checked(tmp_path, monkeypatch):
    path = obj()(tmp_path)
    monkeypatch.setenv("FLX_MAX_PIXELS", "15")
    with pytest.raises(ValueError, match="4 × 4 pixels, more than 15"):
        read_asset(path)
    monkeypatch.setenv("FLX_MAX_PIXELS", "16")
    assert read_asset(path).report.faces == OBJ.count("\nf ")
    monkeypatch.setenv("FLX_MAX_PIXELS", "many")
    with pytest.raises(ValueError, match="whole number"):
        read_asset(path)


# --- what `flx train` would meet


def refusal(words: list[str], capsys) -> str:
    assert main(words) == 2
    said = capsys.readouterr()
    assert said.err.count("\n") == 1 and not said.out
    return said.err


def test_a_face_that_cannot_be_painted_is_refused_by_doctor_and_train_alike(tmp_path, monkeypatch, capsys):
    """A thousand repeats on a strip: little area on the texture, and still no texels of its own."""
    monkeypatch.chdir(tmp_path)
    strip = np.array([[0, 0], [1000, 0], [1000, 0.001], [0, 0.001]])
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
    save(tmp_path, points, strip, np.array([[0, 1, 2], [0, 2, 3]]))
    told = refusal(["doctor", "a.obj"], capsys)
    assert "face 0 spans 1,000 repeats" in told and "unwrap" in told
    assert refusal(["train", "a.obj"], capsys) == told
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("model", "surface", "told"),
    [
        (
            "network='vectors'",
            "",
            "model.network is 'vectors' but 3 of the FL-VAE's 8 channels",
        ),
        ("latents=4", "", "model.latents is 4 but the FL-VAE has 8"),
        ("", "vertices=1000000000", "a copy of 1,000,000,000 vertices takes about"),
        ("", "copies=100000000", "100,000,000 copies of 30,000 vertices take about"),
    ],
)
def test_a_plan_that_cannot_be_trained_is_refused_by_doctor_and_train_alike(
    tmp_path, monkeypatch, capsys, model, surface, told
):
    monkeypatch.chdir(tmp_path)
    obj()(tmp_path)
    config = f"config = FLDMExperiment(model=FLDM({model}), surface=Surface('a.obj', {surface}))"
    Path("plan.py").write_text(f"from flx.config import *\n{config}\n")
    assert told in refusal(["doctor", "a.obj", "--config", "plan.py"], capsys)
    assert told in refusal(["train", "plan.py"], capsys)
    assert not (tmp_path / "runs").exists()


def test_the_plan_is_that_of_flx_train(tmp_path, monkeypatch, capsys):
    path, trained = str(obj()(tmp_path)), []
    assert main(["doctor", path, "--json"]) == 0
    plan = json.loads(capsys.readouterr().out)["plan"]
    learn = lambda experiment, **_: trained.append(experiment) or Run(tmp_path)  # noqa: E731
    monkeypatch.setattr("flx.commands.train.learn", learn)
    assert main(["train", path]) == 0
    assert plan == costs_of(trained[0])._asdict() and plan["compile_seconds"] > 0


def test_what_this_machine_lacks_is_a_warning_with_options_of_train(tmp_path, monkeypatch):
    asset = square(tmp_path, 0.5)
    monkeypatch.setattr("flx.commands.doctor.memory", lambda: Memory(1e9, 1e8))
    monkeypatch.setattr("flx.commands.doctor.room", lambda: 1e6)
    findings = examined(asset)
    assert any("1.0 GB" in text and "--train.batch" in text for text in findings.warnings)
    assert any("24 MB of disk, and 1 MB are free" in text for text in findings.warnings)
    said = describe(asset.report, findings)
    assert "this machine has 1.0 GB" in said and "45 s to compile" in said and "1 part, 1 material" in said
    monkeypatch.setattr("flx.commands.doctor.memory", lambda: None)
    monkeypatch.setattr("flx.commands.doctor.room", lambda: None)
    assert not any("--train.batch" in text or "disk" in text for text in examined(asset).warnings)


def test_materials_and_parts_that_will_mix_are_named(tmp_path):
    two = OBJ.replace("f 2/1 3/2 4/3", "usemtl wood\nf 2/1 3/2 4/3")
    path = obj(lambda _: two, MTL + MTL.replace("skin", "wood"))(tmp_path)
    assert any(
        text.startswith("2 materials are learnt as one") for text in examined(read_asset(path)).warnings
    )
    assert not any("mix" in text for text in examined(square(tmp_path, 0.5)).warnings)


def test_an_image_that_exif_data_turn_is_warned_of(tmp_path):
    exif, content = Image.Exif(), io.BytesIO()
    exif[274] = 6
    Image.new("RGB", (8, 8)).save(content, "JPEG", exif=exif)
    for image, count in ((content.getvalue(), 1), (png(), 0)):
        warnings = examined(read_asset(obj(image=image)(tmp_path))).warnings
        told = [text for text in warnings if "EXIF data turn 'a.png': browsers do so" in text]
        assert len(told) == count


def test_maps_that_do_not_follow_new_colours_and_factors_are_told(tmp_path):
    asset = read_asset(obj(mtl=MTL + "norm a.png\n")(tmp_path))
    findings = examined(asset)
    assert findings.other_maps == ("normal",) and "follow new colours into a GLB" in describe(
        asset.report, findings
    )
    assert "follow new" not in describe(asset.report, examined(square(tmp_path, 0.5)))
    factor = at("materials", 0, "pbrMetallicRoughness", "baseColorFactor", to=[0.5, 0.25, 1, 1])(tmp_path)
    findings = examined(read_asset(factor))
    assert len(findings.tints) == 1 and findings.tints[0].endswith(" × 0.5 0.25 1")


def test_a_plan_that_loses_details_is_told_how_many_vertices_would_keep_them(tmp_path):
    asset = square(tmp_path, 0.5, scale=1.0)
    assert examined(asset).enough_vertices is None  # of one colour
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)
    Image.fromarray(noise).resize((512, 512)).save(tmp_path / "a.png")
    findings = examined(read_asset(tmp_path / "a.obj"), FLDMExperiment(surface=Surface(vertices=50)))
    assert findings.kept_psnr is not None and findings.kept_psnr < 25 and findings.enough_vertices
    told = next(text for text in findings.warnings if "small details are lost" in text)
    assert f"about {findings.enough_vertices:,} would keep 30 dB (--surface.vertices" in told
    enough = FLDMExperiment(surface=Surface(vertices=findings.enough_vertices))
    again = examined(read_asset(tmp_path / "a.obj"), enough)
    assert again.kept_psnr == pytest.approx(30, abs=0.5) and not any("lost" in t for t in again.warnings)
