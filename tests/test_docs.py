"""The documentation names what is there: links, files, modules, commands and their options."""

import os
import re
import subprocess
import sys
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


def links_of(page: Path) -> list[tuple[Path, str]]:
    """The files of the repository that a page links to, each with the heading that is meant."""
    links = [link.partition("#") for link in LINK.findall(page.read_text()) if "://" not in link]
    return [((page.parent / file).resolve() if file else page, heading) for file, _, heading in links]


def test_links_lead_from_the_front_page_to_every_page():
    found, ahead = set(), [ROOT / "README.md"]
    while ahead:
        page = ahead.pop()
        if page not in found and page.suffix == ".md":
            found.add(page)
            ahead += [file for file, _ in links_of(page)]
    assert set((ROOT / "docs").glob("*.md")) <= found


def headings_of(page: Path) -> set[str]:
    """The headings of a page as links name them."""
    headings = re.findall(r"^#+ (.*)", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_heading_that_is_linked_exists(page):
    named = [(file.name, heading) for file, heading in links_of(page) if heading]
    pages = [file for file, heading in links_of(page) if heading]
    assert set(named) <= {(file.name, heading) for file in pages for heading in headings_of(file)}


def test_the_python_api_is_described_on_its_page():
    described = set(
        re.findall(r"^\.\. auto\w+:: ([\w.]+)", (ROOT / "docs" / "api.rst").read_text(), re.MULTILINE)
    )
    assert {f"flx.{name}" for name in flx.__all__ if name != "__version__"} <= described


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(tmp_path):
    for name in ("sphinx", "myst_nb", "furo"):
        pytest.importorskip(name, reason="the extra `docs` is not installed: make setup EXTRAS=dev,docs")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-c", "docs", ".", str(tmp_path)]
    environment = {**os.environ, "FLX_DOCS_EXECUTE": "off"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    pages = {path.relative_to(ROOT).with_suffix(".html") for path in PAGES if path.parent.name != "viewer"}
    assert {page for page in pages if not (tmp_path / page).exists()} == set()
    assert "flx.mesh_tables" in (tmp_path / "docs" / "api.html").read_text()


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
        main([*words, "--help-all"])
    options = set(OPTION.findall(capsys.readouterr().out)) - {"--help"}
    text = (ROOT / "docs" / "cli.md").read_text()
    section = next(part for part in text.split("\n## ") if part.startswith(f"flx {words[0]}\n"))
    assert options - set(OPTION.findall(section)) == set()
    assert options
