"""Laws of where verbs write: no call replaces the files of another one, and the same call finds its own."""

import json
import os
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.files import obj, png
from hypothesis import given
from hypothesis import strategies as st

from flx.assets.asset import own_painting
from flx.assets.read import read_asset
from flx.commands.output import own_folder, settings
from flx.commands.reconstruct import Reconstruct, reconstruct
from flx.commands.sample import Sample, sample
from flx.config import Surface
from flx.controls import Controls
from flx.types import Triangulation


@dataclass(frozen=True)
class Options:
    input: Path
    out: Path | None = None
    count: int = 4
    seed: int = 0
    texture: Path | None = None
    sizes: tuple[int, ...] = (2, 3)


def call(folder: Path, step: int = 100, **options) -> Path:
    """What a verb does with its folder: find it, and leave a record and a file."""
    given = Options(Path("in"), **options)
    wanted = {**settings(given), "step": step}
    out, _ = own_folder(given, folder / "made", f"step-{step}", "record.json", wanted, ["a.glb"])
    out.mkdir(exist_ok=True)
    (out / "record.json").write_text(json.dumps(wanted))
    (out / "a.glb").write_text(f"{wanted}")
    return out


calls = st.fixed_dictionaries(
    {"step": st.sampled_from([100, 200])},
    optional={
        "seed": st.integers(0, 2),
        "texture": st.sampled_from([Path("a/b.png"), Path("a-b.png")]),  # alike as words
        "sizes": st.sampled_from([(2,), (2, 3)]),
    },
)


@given(st.lists(calls, max_size=9))
def test_calls_share_a_folder_only_if_they_make_the_same_files(tmp_path_factory, several):
    folder = tmp_path_factory.mktemp("out")
    for options in several + several:
        call(folder, **options)
    made = [path.read_text() for path in folder.glob("*/a.glb")]
    distinct = {str({"seed": 0, "texture": None, "sizes": (2, 3), **options}) for options in several}
    assert len(made) == len(set(made)) == len(distinct)


def test_names_say_what_is_not_as_usual(tmp_path):
    assert call(tmp_path) == call(tmp_path, count=9) == tmp_path / "made"
    assert call(tmp_path, seed=7).name == "made-seed-7"
    assert call(tmp_path, seed=7, texture=Path("/x/b c.png")).name == "made-seed-7-texture-x-b-c-png"
    assert call(tmp_path, step=200).name == "made-step-200"
    assert call(tmp_path) == tmp_path / "made"


def test_files_without_a_record_and_a_broken_record_are_left_alone(tmp_path):
    (tmp_path / "made").mkdir()
    (tmp_path / "made" / "a.glb").write_text("mine")
    assert call(tmp_path).name == "made-step-100"
    (tmp_path / "made-step-100" / "record.json").write_text("[" * 100_000)
    assert call(tmp_path).name == "made-step-100-2"
    assert (tmp_path / "made" / "a.glb").read_text() == "mine"


def test_a_folder_that_is_named_is_taken_or_refused_but_never_exchanged(tmp_path):
    out = tmp_path / "mine"
    assert call(tmp_path, out=out, seed=7) == call(tmp_path, out=out, seed=7, count=2) == out
    with pytest.raises(ValueError, match=r"mine holds the files of another call \(seed = 7, not 8\); name"):
        call(tmp_path, out=out, seed=8)
    assert list(tmp_path.iterdir()) == [out] and '"seed": 7' in (out / "record.json").read_text()


# --- the verbs


@pytest.fixture
def generator(tmp_path, monkeypatch) -> SimpleNamespace:
    """A stand-in for the generator of any run: its variations are the asset's own colours."""
    asset = read_asset(obj()(tmp_path))
    home = SimpleNamespace(triangulation=Triangulation(np.zeros((4, 3)), np.zeros((2, 3), np.int64)))
    experiment = SimpleNamespace(surface=Surface())
    schedule = np.linspace(1, 0.1, 101)
    rest = {"asset": asset, "asset_with_maps": asset._replace(), "home": home, "experiment": experiment}
    made = SimpleNamespace(params={}, alphas=schedule, step=5, **rest)
    monkeypatch.setattr("flx.training.load.load_generator", lambda _: made)
    monkeypatch.setattr("flx.pipeline.variations.generate", lambda g, n, *_: iter([own_painting(asset)] * n))
    monkeypatch.setattr("flx.pipeline.variations.check_controls", lambda *_: None)
    monkeypatch.setattr("flx.pipeline.transfer.vertex_count", lambda *_: 4)
    (tmp_path / "run").mkdir()
    return made


def test_samples_of_another_seed_or_step_or_network_go_elsewhere(generator, tmp_path):
    plain = Sample(tmp_path / "run", count=1)
    assert sample(plain) == sample(replace(plain, up="z")) == tmp_path / "run" / "samples"
    assert sample(replace(plain, seed=7)).name == "samples-seed-7"
    assert sample(replace(plain, sampler="ddim", steps=9)).name == "samples-steps-9-sampler-ddim"
    assert sample(replace(plain, controls=Controls(strength=0.5))).name == "samples-strength-0-5"
    generator.step = 9
    assert sample(plain).name == "samples-step-9"
    generator.params = {"w": np.ones(3)}
    assert sample(plain).name == "samples-step-9-2"
    assert len(list((tmp_path / "run").glob("*/variation_00.glb"))) == 6


def test_samples_by_labels_that_were_painted_over_go_elsewhere(generator, tmp_path):
    labels = tmp_path / "map.png"
    labels.write_bytes(b"first")
    guided = Sample(tmp_path / "run", count=1, controls=Controls(labels=labels))
    first = sample(guided)
    assert sample(guided) == first
    labels.write_bytes(b"painted over")
    assert sample(guided) != first


def test_other_maps_follow_where_the_file_holds_them_and_there_are_pieces(generator, tmp_path, monkeypatch):
    painted = []

    def generate(_, count, seed, steps, sampler, texture_size, asset, *rest):
        painted.append(asset)
        return iter([own_painting(asset)] * count)

    monkeypatch.setattr("flx.pipeline.variations.generate", generate)
    for options in (
        {},
        {"variants": True},
        {"format": "obj"},
        {"controls": Controls(invention=1.0)},
        {"controls": Controls(strength=0.5)},
    ):
        sample(Sample(tmp_path / "run", count=1, viewer=False, **options))
    assert painted[0] is generator.asset_with_maps
    assert all(asset is generator.asset for asset in painted[1:]) and len(painted) == 5


def test_the_record_of_samples_grows_as_files_appear_and_loses_none(generator, tmp_path, monkeypatch):
    made, asset, out = [], generator.asset, tmp_path / "run" / "samples"

    def stops(_, count, *rest):
        for n in range(count):
            listed = json.loads((out / "samples.json").read_bytes())["files"]
            made.append((listed, sorted(path.name for path in out.glob("*.glb"))))
            if n == 2:
                raise KeyboardInterrupt
            yield own_painting(asset)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("flx.pipeline.variations.generate", stops)
        sample(Sample(tmp_path / "run"))
    assert len(made) == 3 and all(listed == there for listed, there in made) and len(made[2][0]) == 2
    assert sample(Sample(tmp_path / "run", count=1)) == out  # the other is still there, and listed
    record = json.loads((out / "samples.json").read_bytes())
    assert record["files"] == ["variation_00.glb", "variation_01.glb"] and len(record["seam_ratios"]) == 2
    assert record["seed"] == 0 and record["step"] == 5
    assert record["invention"] == 0.2 and record["steps"] == 5, "0.2 of 25"


@pytest.mark.slow
def test_meshes_of_one_name_are_reconstructed_into_folders_of_their_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folders, contents = [], []
    for place, image in (("x", png()), ("y", png(8, 8)), ("x", png())):
        Path(place).mkdir(exist_ok=True)
        options = Reconstruct(obj(image=image)(Path(place)), vertices=60, texture_size=16)
        folders.append(Path(reconstruct(options)["folder"]))
        contents.append((folders[-1] / "reconstruction.glb").read_bytes())
    assert folders[0] == folders[2] == Path("runs/a-there-and-back-vertices-60-texture-size-16")
    assert folders[1] != folders[0] and (folders[0] / "reconstruction.glb").read_bytes() == contents[0]
    assert contents[1] != contents[0] == contents[2]


def test_a_page_of_all_variations_is_written_last_and_named_last(generator, tmp_path, capsys):
    folder = sample(Sample(tmp_path / "run", count=2))
    content = (folder / "viewer.html").read_bytes()
    assert content.count(b'"name":"variation 0') == 2 and b'"file":"variation_01.glb"' in content
    assert b'["seed","0"],["run","run"]' in content
    Sample(tmp_path / "run", count=2)()
    said = capsys.readouterr()
    assert said.out.splitlines() == [str(folder)] and (folder / "viewer.html").read_bytes() == content
    assert said.err.splitlines()[-1] == f"flx: to look at them, open {folder / 'viewer.html'} in a browser"


def test_variants_are_shown_each_and_downloaded_together(generator, tmp_path):
    content = (sample(Sample(tmp_path / "run", count=2, variants=True)) / "viewer.html").read_bytes()
    assert content.count(b'"name":"variation 0') == content.count(b'"file":"variants.glb"') == 2


def test_no_page_is_written_where_none_is_wanted(generator, tmp_path, capsys):
    Sample(tmp_path / "run", count=1, viewer=False)()
    out = tmp_path / "run" / "samples"
    assert (out / "variation_00.glb").exists() and not (out / "viewer.html").exists()
    assert "viewer" not in capsys.readouterr().err
    assert sample(Sample(tmp_path / "run", count=1)) == out, "the option makes no other variations"


def test_a_page_that_fails_costs_a_line_and_nothing_else(generator, tmp_path, capsys, monkeypatch):
    first = sample(Sample(tmp_path / "run", count=1))
    capsys.readouterr()
    monkeypatch.setattr(
        "flx.commands.viewer.page", lambda *rest: (_ for _ in ()).throw(ValueError("too\nlarge"))
    )
    Sample(tmp_path / "run", count=2)()
    said = capsys.readouterr()
    assert said.err.splitlines()[-1] == (
        f"flx: {first / 'viewer.html'} was not written (too large); --no-viewer leaves it out"
    )
    assert said.out.strip() == str(first) and (first / "variation_01.glb").exists()
    assert not (first / "viewer.html").exists(), "an older page would mislead"


def test_a_page_of_someone_else_is_left_alone(generator, tmp_path):
    mine = tmp_path / "run" / "samples" / "viewer.html"
    mine.parent.mkdir()
    mine.write_text("mine")
    assert sample(Sample(tmp_path / "run", count=1)).name == "samples-step-5"
    assert mine.read_text() == "mine"


def test_a_folder_that_cannot_be_made_is_refused_before_the_work(generator, tmp_path):
    (tmp_path / "nowhere").symlink_to("else")
    for out, fault in (("nowhere", "is a link that leads nowhere"), ("x" * 256, "File name too long")):
        with pytest.raises(ValueError, match=rf"{fault}\)?; name another folder with --out"):
            sample(Sample(tmp_path / "run", count=1, out=tmp_path / out))
    assert not os.path.lexists(tmp_path / "else")
