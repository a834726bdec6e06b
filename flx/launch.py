"""The `flx` command: one launcher for everything.

  flx doctor MESH          what is in a mesh file, and what would be repaired
  flx train MESH|CONFIG.py prepare (cached) and train; the same command resumes
  flx watch RUN            its curves and previews in a browser, while it trains
  flx sample RUN           new textures from a run
  flx labels MESH          a proposal for labels, which say what goes where
  flx paint MESH           labels, masks and directions, painted in a browser
  flx reconstruct MESH     a texture through the FL-VAE and back, with its metrics
  flx evaluate             a table: how well each method keeps the textures of some meshes
  flx bench                timings of this machine

`flx COMMAND --help` lists its options, of train and sample the first ones, and `--help-all` all. Exit status:
0 done, 1 failed on the way, 2 wrong input, 130 stopped by Ctrl-C. Errors are one line; `--verbose` adds the
traceback.
"""

import contextlib
import hashlib
import io
import os
import platform
import re
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path

from flx import __version__
from flx.stopping import ended_by_signals

COMMANDS = ("doctor", "watch", "sample", "labels", "paint", "reconstruct", "evaluate", "bench")  # and train
ALLOCATOR = {"hugetlb": 1, "mmap_threshold": 2**33, "trim_threshold": 2**34}  # thresholds in bytes
LESS = {  # what of a command takes less memory
    "train": "use fewer --surface.vertices, --model.channels or a smaller --train.batch",
    "sample": "use a smaller --texture-size or a larger --scale",
    "reconstruct": "use fewer --vertices or a smaller --texture-size",
    "evaluate": "use a smaller --texture-size or a smaller --count",
}
PROGRAM_BYTES = 2**29  # kept of compiled programs; the least recently used go first


def parse(words: Sequence[str]) -> Callable[[], None]:
    """The command that the words name, with its options, ready to be called.

    Raises ValueError where `flx train` gets neither a mesh nor a config, and SystemExit after help or for a
    wrong option (the message names the nearest one).
    """
    # Loaded here: signals are answered by now, and the processes that make copies, which load this file too,
    # need none of it. JAX is loaded inside the commands, so that `--help` and `doctor` stay quick.
    from tyro.extras import SubcommandApp

    from flx.commands import train
    from flx.commands.bench import Bench
    from flx.commands.doctor import Doctor
    from flx.commands.evaluate import Evaluate
    from flx.commands.labels import ProposeLabels
    from flx.commands.paint import Paint
    from flx.commands.reconstruct import Reconstruct
    from flx.commands.sample import Sample
    from flx.commands.watch import Watch

    app = SubcommandApp()
    app.command(name="train")(train.command(words[1:] if words[0] == "train" else ()))
    commands = (Doctor, Watch, Sample, ProposeLabels, Paint, Reconstruct, Evaluate, Bench)
    for name, command in zip(COMMANDS, commands, strict=True):
        app.command(name=name)(command)
    return app.cli(prog="flx", args=words)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return the exit status."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    verbose = "--verbose" in words
    words = [word for word in words if word != "--verbose"]
    if not words or words[0] in ("-h", "--help"):
        print(__doc__)
        return 0 if words else 2
    if words[0] == "--version":
        print(f"flx {__version__}")
        return 0
    if words[0] not in ("train", *COMMANDS) and not words[0].startswith("--tyro"):
        names = ", ".join(["train", *COMMANDS])
        return _complain(f"there is no command {words[0]!r}; use one of {names}", 2)
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    keep_compiled_programs()
    asked = {"--help", "-h", "--help-all"} & {*words}
    words = ["--help" if word == "--help-all" else word for word in words]
    try:
        with ended_by_signals(), short_help(words[0], asked):
            with refusals_in_one_line(words[0]):
                run = parse(words)
            run()
    except (ValueError, OSError, FloatingPointError, MemoryError, RuntimeError) as error:
        if verbose:
            traceback.print_exc()
        if lacking := lack_of_memory(error, words[0]):
            return _complain(lacking, 1)
        if isinstance(error, RuntimeError):  # a fault of flx itself
            raise
        wrong_input = isinstance(error, ValueError | FileNotFoundError | IsADirectoryError)
        return _complain(" ".join(str(error).split()) or type(error).__name__, 2 if wrong_input else 1)
    return 0


@contextlib.contextmanager
def refusals_in_one_line(verb: str) -> Iterator[None]:
    """What tyro refuses, in a frame of many lines, is a ValueError of one."""
    encoding = getattr(sys.stderr, "encoding", None) or "utf-8"
    told = io.TextIOWrapper(content := io.BytesIO(), encoding, "replace", write_through=True)
    try:
        with contextlib.redirect_stderr(told):
            yield
    except SystemExit:
        from flx.commands.help import refusal

        text = content.getvalue().decode(encoding, "replace")
        if refused := refusal(verb, text):
            raise ValueError(refused) from None
        print(text, end="", file=sys.stderr)
        raise
    print(content.getvalue().decode(encoding, "replace"), end="", file=sys.stderr)


@contextlib.contextmanager
def short_help(verb: str, asked: Collection[str]) -> Iterator[None]:
    """Where help is asked for, but not all of it, only what a beginner sets is printed.

    Its boxes are known by their frames, which only Unicode has.
    """
    from flx.commands.help import FIRST, shortened

    unicode = (sys.stdout.encoding or "").lower().startswith("utf")
    if not asked or "--help-all" in asked or verb not in FIRST or not unicode:
        yield
        return
    said = io.TextIOWrapper(content := io.BytesIO(), encoding="utf-8", write_through=True)
    try:
        with contextlib.redirect_stdout(said):
            yield
    finally:
        print(shortened(verb, content.getvalue().decode()))


def lack_of_memory(error: Exception, verb: str) -> str:
    """What there was no memory for, and what takes less; "" for any other error, and for one that says it.

    JAX raises a RuntimeError of its own for that, on CPUs and on GPUs.
    """
    said = " ".join(str(error).split())
    of_jax = isinstance(error, RuntimeError) and "RESOURCE_EXHAUSTED" in said
    if not of_jax and not (isinstance(error, MemoryError) and ";" not in said):
        return ""
    sizes = re.search(r"(?:allocat\w+|allocate) ([\d.,]+ ?[KMGTPE]?i?[Bb](?:ytes)?)", said)
    what = f" for {sizes[1]}" if sizes else ""
    less = LESS.get(verb, "close other programs, or take a larger machine")
    return f"there is not enough memory{what}; {less}"


def command() -> int:
    """`main` as the process that a shell started."""
    if "--instant" not in sys.argv:  # there a network runs
        use_large_pages()
    if isinstance(sys.stdout, io.TextIOWrapper):  # letters that it cannot write are spelt out, as on stderr
        sys.stdout.reconfigure(errors="backslashreplace")
    return main()


def use_large_pages() -> None:
    """Start this process again with an allocator that keeps its memory, in large pages; only glibc has one.

    In each step of training XLA takes and returns hundreds of megabytes; by default the kernel maps and
    clears them anew, which is a fifth of the step's time. GLIBC_TUNABLES is read only when a process starts.
    Where it is set already, it stays.
    """
    if "GLIBC_TUNABLES" in os.environ or platform.libc_ver()[0] != "glibc":
        return
    os.environ["GLIBC_TUNABLES"] = ":".join(
        f"glibc.malloc.{name}={value}" for name, value in ALLOCATOR.items()
    )
    with contextlib.suppress(OSError):  # then this process goes on as it is
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


def keep_compiled_programs() -> None:
    """Have JAX, which is imported later, keep what it compiles in $FLX_CACHE, ~/.cache/flx unless set.

    Nothing is kept where FLX_CACHE is empty or the folder cannot be written; a cache directory set for JAX
    itself stays. Each kind of processor has a folder of its own, since programs are machine code.
    """
    place = os.environ.get("FLX_CACHE", os.path.join(os.environ.get("XDG_CACHE_HOME") or "~/.cache", "flx"))
    if not place or "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    programs = Path(place).expanduser() / f"programs-{_processor()}"
    try:
        programs.mkdir(mode=0o700, parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=programs).close()
    except (OSError, RuntimeError):  # RuntimeError: a user without a home
        return
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(programs)
    os.environ.setdefault("JAX_COMPILATION_CACHE_MAX_SIZE", str(PROGRAM_BYTES))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")
    # What cannot be read, or is damaged, is compiled again.
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache")


def _processor() -> str:
    """A short name for the instructions that this machine's processor knows."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    flags = next((line for line in lines if line.lower().startswith(("flags", "features"))), "")
    return hashlib.sha256(f"{platform.machine()} {platform.processor()} {flags}".encode()).hexdigest()[:12]


def _complain(message: str, status: int) -> int:
    print(f"flx: {message}", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(command())
