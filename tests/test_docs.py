"""The documentation names what is there: links, files, modules, commands and their options."""

import re
from pathlib import Path

import pytest

import flx
from flx.launch import COMMANDS, main

VERBS = sorted({"train", *COMMANDS})
ROOT = Path(__file__).parent
while not (ROOT / "pyproject.toml").exists():
    ROOT = ROOT.parent
PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *(ROOT / "flx").rglob("*.md")]
PATH = re.compile(r"`((?:flx|experiments|tests|docs|notebooks)/[\w./-]*)`")
LINK = re.compile(r"\]\(([^)\s]+)\)")
OPTION = re.compile(r"--(?!no-)[a-z][a-z.-]+")
COMING = {  # described already
    "experiments/fldm_paper.py",
    "experiments/gpu.py",
    "flx/assets/assemble.py",
    "flx/commands/evaluate.py",
    "flx/evaluation/timings.py",
    "flx/models/denoiser/unet.py",
    "flx/pipeline/generator.py",
    "tests/reports/hard.py",
    "tests/reports/hostile.py",
    "test-fast",
}
API = "load from_arrays from_trimesh vase triangulate load_codec paint save to_trimesh show fidelity train"
COMING |= {f"flx.{name}" for name in (*API.split(" "), "FLDMExperiment", "load_generator", "generate")}


def missing(text: str, folder: Path) -> list[str]:
    """The files that a page in `folder` links to or names, and that are not there."""
    links = [link.split("#")[0] for link in LINK.findall(text) if "://" not in link]
    linked = [link for link in links if link and not (folder / link).exists()]
    return linked + [n for n in PATH.findall(text) if not (ROOT / n).exists() and n not in COMING]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_and_every_named_file_exists(page):
    assert missing(page.read_text(), page.parent) == []


def test_the_check_of_links_can_fail():
    assert missing("[a](nowhere.md) `flx/nowhere.py` [b](https://example.org)", ROOT) == [
        "nowhere.md",
        "flx/nowhere.py",
    ]


def test_the_front_page_fits():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 130


def test_every_page_is_linked_from_the_front_page():
    linked = LINK.findall((ROOT / "README.md").read_text())
    assert {f"docs/{page.name}" for page in (ROOT / "docs").glob("*.md")} <= set(linked)


def test_every_module_has_its_line_in_the_architecture():
    text = (ROOT / "docs" / "architecture.md").read_text()
    modules = [path for path in (ROOT / "flx").rglob("*.py") if path.name != "__init__.py"]
    names = [path.relative_to(ROOT).as_posix() for path in modules]
    assert [name for name in names if f"| `{name}` |" not in text] == []


def test_every_verb_and_experiment_is_documented():
    text = (ROOT / "docs" / "cli.md").read_text()
    assert [verb for verb in VERBS if f"## flx {verb}" not in text] == []
    experiments = [f"`experiments/{path.name}`" for path in (ROOT / "experiments").glob("*.py")]
    assert [name for name in experiments if name not in text] == []


def test_every_make_target_that_is_named_exists():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    command = re.compile(r"(?:^|`)make ([a-z-]+)(?=$|`|  | [A-Z])", re.MULTILINE)
    named = {target for page in PAGES for target in command.findall(page.read_text())}
    assert named > {"demo", "test"}
    assert named - targets - COMING == set()


def test_every_name_of_the_python_api_exists():
    pages = (ROOT / "README.md").read_text() + (ROOT / "docs" / "architecture.md").read_text()
    named = {name for name in re.findall(r"\bflx\.([A-Za-z_]+)\b(?!/)", pages)}
    assert named > {"load", "generate"}
    assert [name for name in sorted(named) if not hasattr(flx, name) and f"flx.{name}" not in COMING] == []


@pytest.mark.parametrize(
    "words",
    [[verb] for verb in VERBS if verb != "train"]
    + [["train", str(ROOT / "experiments" / name)] for name in ("demo.py", "flvae.py")],
    ids=lambda words: Path(words[-1]).stem,
)
def test_every_option_is_documented(words, capsys):
    with pytest.raises(SystemExit):
        main([*words, "--help"])
    options = set(OPTION.findall(capsys.readouterr().out)) - {"--help"}
    text = (ROOT / "docs" / "cli.md").read_text()
    section = next(part for part in text.split("\n## ") if part.startswith(f"flx {words[0]}\n"))
    assert options - set(OPTION.findall(section)) == set()
    assert options
