"""`--help` for beginners: the first options of a verb; `--help-all` lists every one."""

import re
from collections.abc import Collection, Iterator

FIRST = {
    "train": "--name --workers --surface.path --surface.texture --surface.labels --surface.direction "
    "--surface.vertices --surface.copies --surface.up --train.steps --images.folder --model.channels",
    "sample": "--instant --texture --count --seed --out --texture-size --format --mesh --scale --keep "
    "--fill --labels --direction --height --strength --variants",
}


def shortened(verb: str, text: str) -> str:
    """The help of a verb with its first options alone, and where the others are."""
    first = FIRST[verb].split()
    kept = [line for box in _boxes(text.splitlines()) for line in _kept(box, first)]
    return "\n".join([*kept, f"flx {verb} --help-all lists every option."])


def _boxes(lines: list[str]) -> Iterator[list[str]]:
    """Runs of lines: a box with its frame, or what is between boxes."""
    run: list[str] = []
    for line in lines:
        if line.startswith("╭") and run:
            yield run
            run = []
        run.append(line)
        if line.startswith("╰"):
            yield run
            run = []
    if run:
        yield run


def _kept(box: list[str], first: Collection[str]) -> list[str]:
    """A box of options with the first ones alone; nothing of a box that has none of them."""
    if not box[0].startswith("╭") or "positional" in box[0]:
        return box
    kept, inside, found = [], True, False  # what a box is about comes before its options
    for line in box:
        words = line.strip("│").split()
        if line.startswith("│ -"):
            inside = words[0].rstrip(",") in first
            found |= inside
        if inside or line is box[-1]:
            kept.append(line)
    return kept if found else []


def refusal(verb: str, text: str) -> str | None:
    """One line for what tyro refuses in a frame of many; None where it says something else."""
    words = " ".join(re.sub("[│╭╮╰╯─+|]", " ", text).split())
    words = re.split(r" -* ?For full helptext", words)[0]
    listed = f"`flx {verb} --help-all` lists what there is"
    number = r"(?:(int\(\)) with base 10|to float): '(.*?)' -* ?Argument helptext: (--\S+)"
    if found := re.search(number, words):
        return f"{found[3]} is {found[2]!r}; give a {'whole ' if found[1] else ''}number"
    if found := re.search(r"Error parsing [^ :]+: (.*)", words):
        return found[1].strip(" -")
    if found := re.search(r"Unrecognized options: ([^ ,=]+)", words):
        near = re.search(r"Perhaps you meant: ([^ ,]+)", words)
        if not found[1].startswith("-"):
            return f"{found[1]!r} is one word too many; {listed}"
        return f"there is no option {found[1]}; " + (f"{near[1]} is the nearest one" if near else listed)
    if found := re.search(r"Missing from [^:]*: (\S+) (.*?) \(required\)", words):
        return f"{verb} needs {found[1]}: {found[2].rstrip('.')}"
    if found := re.search(r"Missing value for argument '([^']+)'", words):
        return f"{found[1]} needs a value; {listed}"
    if found := re.search(
        r"invalid choice '([^']*)' for argument '([^']+)'\. Expected one of \((.*)\)", words
    ):
        return f"{found[2]} is {found[1]!r}; choose one of {found[3].replace(chr(39), '').strip(',')}"
    return None
