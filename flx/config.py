"""All settings: frozen dataclasses with the paper's values as defaults.

An experiment file makes one `FLVAEExperiment` or `FLDMExperiment` and names it `config`; the launcher
overrides single fields from the command line. A number out of its range is refused when it is set.
"""

import contextlib
import importlib.util
import math
import os
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from flx.arguments import briefly, check_kind, number, whole

Precision = Literal["bfloat16", "float32"]
Blocks = tuple[int, int, int]  # of a network: fine before pooling, coarse, fine after
Filter = Literal["harmonic", "mlp"]
FRAME_VECTORS = 48  # the most vectors that the frame encoder can give a code: those of its polynomials
FRAME_PAIRS = 3  # the most pairs of scalars: mean colour and its curvature
Sampler = Literal["ddim", "dpm", "ancestral"]  # deterministic; of second order; DDPM
STEPS = 25  # evaluations of the network for a sample, unless given
Compared = Literal["flvae", "barycentric", "inf", "vertex_colours", "pca", "frame_pca"]  # by `flx evaluate`


# What records of earlier versions lack, and meant.
ADDED = {
    "draws": "uniform",
    "emphasis": 0.0,
    "label_dropout": 0.1,
    "labels": None,
    "directions": 0,
    "direction_dropout": 0.1,
    "direction": "",
    "fill": None,
    "codes": "means",
    "accumulate": 1,
}

# The largest numbers of a network: beyond them, building it takes minutes before anything is noticed.
MOST_LAYERS, MOST_OTHER = 100, 1 << 20
LAYERS = ("depth", "layers", "decoder_layers", "vn_layers")


def check_all(part: str, values: object, **least: int | float) -> None:
    """Raises ValueError for a word that its field does not know, for what is no number or no text where one
    is needed, and for a number out of its range."""
    for name, kind in get_type_hints(type(values)).items():
        choices, value, place = get_args(kind), getattr(values, name), f"{part}.{name}"
        if get_origin(kind) is Literal and value not in choices:
            raise ValueError(f"{place} is {value!r}; choose {' or '.join(choices)}")
        if kind is int:  # as Python's own, which JSON can hold
            object.__setattr__(values, name, whole(place, value, int(least.get(name, 0))))
        elif kind is float:
            object.__setattr__(values, name, number(place, value, least.get(name, -math.inf)))
        elif kind is str:
            check_kind(place, value, str, "text")
    for name in least:
        most = MOST_LAYERS if name in LAYERS else MOST_OTHER
        if part == "model" and getattr(values, name) > most:
            raise ValueError(f"{part}.{name} is {getattr(values, name)}; give at most {most:,}")


def _are_blocks(values: object) -> bool:
    counts = values if isinstance(values, tuple) else ()
    return len(counts) == 3 and all(isinstance(n, int) and 1 <= n <= MOST_LAYERS for n in counts)


@dataclass(frozen=True)
class FLVAE:
    """The field-latent VAE (paper, section 3 and supplement B.1)."""

    encoder: Literal["transformer", "frame"] = "transformer"  # "frame" is ours, far cheaper a ring
    channels: int = 128  # complex channels of the transformer
    layers: int = 8  # VN-Transformer layers
    heads: int = 8
    latents: int = 8  # D, complex numbers a vertex
    invariants: int = 0  # of these, channels that do not turn: two real numbers each; "frame" only
    samples: int = 64  # colour samples a one-ring
    decoder: Literal["field", "interpolated"] = "field"  # "interpolated" is what the paper compares with
    decoder_width: int = 512  # of the transformer's decoder and of the interpolated one
    decoder_layers: int = 5
    width: int = 256  # of the MLPs of "frame"
    depth: int = 3  # their hidden layers
    edges: int = 24  # soft edges a vertex; "frame" only
    sharpness: float = 1.0  # of the blend of a face's corners: barycentrics to this power
    precision: Precision = "bfloat16"  # inputs of the matrix products; sums are float32

    def __post_init__(self) -> None:
        check_all("model", self, channels=1, layers=0, heads=1, latents=1, invariants=0, samples=1)
        check_all("model", self, decoder_width=1, decoder_layers=1, width=1, depth=0, edges=1, sharpness=1)
        invariants = self.invariants
        if self.encoder == "transformer" and invariants:
            raise ValueError(f"model.invariants is {invariants}; make it 0, since the transformer has none")
        if self.encoder == "transformer" and self.channels % self.heads:
            raise ValueError(f"model.heads is {self.heads}; make it divide model.channels, {self.channels}")
        vectors = self.latents - self.pairs
        if self.encoder == "frame" and not (invariants <= FRAME_PAIRS and 1 <= vectors <= FRAME_VECTORS):
            raise ValueError(
                f"model.invariants is {invariants} of {self.latents} latents; the frame encoder needs at "
                f"most {FRAME_PAIRS}, and 1 to {FRAME_VECTORS} vectors (of codes without invariants, "
                f"{FRAME_PAIRS} more)"
            )
        if self.decoder == "interpolated" and self.sharpness != 1:
            raise ValueError(f"model.sharpness is {self.sharpness}; make it 1 for the interpolated decoder")

    @property
    def pairs(self) -> int:
        """Channels of the frame encoder that hold two scalars each; without invariants they turn."""
        return self.invariants or FRAME_PAIRS


@dataclass(frozen=True)
class FLDM:
    """The field-latent diffusion model (paper, section 4 and supplement B.2)."""

    # "vectors" is the paper's network, "mixed" is ours for codes with invariant channels. None (also in the
    # next two fields and in `blocks`) means: what the FL-VAE's codes and the number of vertices need.
    network: Literal["vectors", "mixed"] | None = None
    latents: int | None = None
    invariants: int | None = None
    channels: int = 96  # of the fine level; the coarse level has twice as many
    filter: Filter = "harmonic"  # Of the convolutions: "harmonic" is ours, twice as fast; "mlp" the paper's.
    filter_width: int = 8  # channels inside the filter
    vn_layers: int = 3  # layers of each VN MLP
    embedding: int = 128  # width of the scalar embedding π
    conditions: int = 0  # m, real conditions ρ at each vertex: as many as labels
    label_dropout: float = 0.1  # probability that a draw sees no labels, for samples without them
    directions: int = 0  # vector conditions at each vertex: 1 with a direction
    direction_dropout: float = 0.1  # probability that a draw sees no direction
    blocks: Blocks | None = None
    predicts: Literal["noise", "velocity"] = "noise"  # the paper's; ours for short trainings
    # Steps t that training draws: the paper's; ours, most of them where shapes are decided.
    draws: Literal["uniform", "lognormal"] = "uniform"
    # What training sees of a one-ring: the mean of the FL-VAE's posterior, or (the paper's) each time a draw.
    codes: Literal["means", "draws"] = "means"
    emphasis: float = 0.0  # of channels that show: scales are multiplied by (effect on colours)^emphasis
    steps: int = 1000  # T, the steps of the noise schedule; not those of the training.
    beta_start: float = 1e-4  # linear schedule: ᾱ_T = 4e-5
    beta_end: float = 2e-2
    precision: Precision = "bfloat16"

    def __post_init__(self) -> None:
        check_all("model", self, channels=1, filter_width=1, vn_layers=1, embedding=4, conditions=0, steps=1)
        check_all("model", self, beta_start=0, beta_end=0, emphasis=0, label_dropout=0, direction_dropout=0)
        for name in ("label_dropout", "direction_dropout"):
            if getattr(self, name) > 1:
                raise ValueError(f"model.{name} is {getattr(self, name)}; give a probability, 0 to 1")
        for name in ("beta_start", "beta_end"):
            if getattr(self, name) >= 1:
                raise ValueError(f"model.{name} is {getattr(self, name)}; give less than 1, a share of noise")
        if self.embedding % 2:
            raise ValueError(f"model.embedding is {self.embedding}; make it even, for cosines and sines")
        if self.blocks is not None and not _are_blocks(self.blocks):
            raise ValueError(f"model.blocks is {self.blocks!r}; give three numbers of 1 to {MOST_LAYERS}")

    @property
    def code_channels(self) -> tuple[int, int]:
        """How many channels of a code are vectors, and how many invariants.

        Raises ValueError where they are not set yet (see `flx.models.denoiser.depth.complete`).
        """
        if self.latents is None:
            raise ValueError("model.latents is not set; complete the model for an FL-VAE first")
        return self.latents - (self.invariants or 0), self.invariants or 0


@dataclass(frozen=True)
class Surface:
    """The textured mesh an FLDM learns, and how it is triangulated."""

    path: str = ""  # a .glb, .gltf, .obj or .ply file; empty: the vase that flx makes itself
    texture: str | None = None  # an image to use instead of the file's own
    labels: str | None = None  # An image of flat colours on the same UVs, or a PLY, that says what is where.
    direction: str = ""  # Which way the texture runs: x, y, z, curvature, or a JSON file of strokes.
    fill: str | None = None  # A mask as large as the texture: what is white is damaged, and not learnt.
    vertices: int = 30_000  # Vertices of each copy: more for finer detail, and more time.
    copies: int = 500  # Independent triangulations of the mesh.
    slots: int = 16  # most neighbours of a vertex, itself included
    up: Literal["y", "z"] = "y"  # The axis that points up in the pictures.
    seed: int = 0

    def __post_init__(self) -> None:
        check_all("surface", self, vertices=4, copies=1, slots=4, seed=0)


@dataclass(frozen=True)
class Images:
    """The images an FL-VAE learns, and the planar meshes laid over them."""

    folder: str = ""
    prints: float = 0.2  # pages of flat shapes and letters made for each image of the folder
    queries: int = 8  # points decoded for each vertex
    smallest: float = 1.2  # pixels in a mean vertex radius, least and most
    largest: float = 16.0
    seed: int = 0

    def __post_init__(self) -> None:
        check_all("images", self, prints=0, queries=1, smallest=0.1, seed=0)
        check_all("images", self, largest=self.smallest)


@dataclass(frozen=True)
class Train:
    """The optimiser and the rhythm of a run."""

    steps: int = 300_000  # Steps of the training: more for a better texture, and more time.
    batch: int = 16  # Mesh copies in a step; for an FL-VAE, patches of 24 one-rings.
    accumulate: int = 1  # Parts of a batch that are worked on one after the other, in less memory; an FLDM's.
    optimizer: Literal["adam", "muon"] = "adam"  # the paper's; ours for short trainings
    learning_rate: float = 1e-3  # cosine to `final_learning_rate`
    final_learning_rate: float = 1e-5
    warmup: int = 0  # steps; at most half of all
    clip: float = 0.0  # largest norm of the gradient; 0: no limit
    ema: float = 0.999  # How slowly the averaged weights, which sampling uses, follow; less than 1.
    checkpoint_every: int = 1000  # Steps between checkpoints.
    log_every: int = 50  # Steps between rows of metrics.csv.
    seed: int = 0

    def __post_init__(self) -> None:
        check_all("train", self, steps=1, batch=1, warmup=0, checkpoint_every=1, log_every=1, seed=0)
        check_all("train", self, learning_rate=0, final_learning_rate=0, clip=0, ema=0, accumulate=1)
        if self.batch % self.accumulate:
            raise ValueError(
                f"train.accumulate is {self.accumulate}; give a number that divides train.batch, {self.batch}"
            )
        if self.ema >= 1:
            raise ValueError(f"train.ema is {self.ema}; give less than 1, for weights that follow")


@dataclass(frozen=True)
class FLVAEExperiment:
    """Train a field-latent VAE on a folder of images."""

    name: str = "flvae"
    model: FLVAE = field(default_factory=FLVAE)
    kl_weight: float = 0.01
    learns: Literal["corners", "blend"] = "corners"  # the paper's: each vertex alone; ours: what is seen
    images: Images = field(default_factory=Images)
    train: Train = field(default_factory=lambda: Train(steps=1_500_000))

    def __post_init__(self) -> None:
        if self.train.accumulate > 1:
            raise ValueError(
                f"train.accumulate is {self.train.accumulate}; an FL-VAE takes 1: make train.batch smaller"
            )


@dataclass(frozen=True)
class FLDMExperiment:
    """Train a field-latent diffusion model on one textured mesh."""

    name: str = "fldm"  # The run's folder is runs/NAME.
    surface: Surface = field(default_factory=Surface)
    train: Train = field(default_factory=Train)
    model: FLDM = field(default_factory=FLDM)
    # An FL-VAE file to use instead of the released one; `vectors`: the shipped one of tangent vectors alone.
    weights: str | None = None


Experiment = FLVAEExperiment | FLDMExperiment


@dataclass(frozen=True)
class Comparison:
    """What `flx evaluate --reconstruction` measures."""

    reconstruction: tuple[str, ...] = ()  # textures to send: MESH, MESH:TEXTURE, or an image as a sheet
    # folder to write to; RUN/evaluation unless given, or `evaluation`, with what is not as usual in its name
    out: Path | None = None
    vertices: tuple[int, ...] = (30_000, 5_000)  # of the triangulations; one row each
    methods: tuple[Compared, ...] = get_args(Compared)  # which methods to measure
    images: Path | None = None  # folder of images to fit pca and frame_pca to; skipped without it
    texture_size: int | None = None  # pixels on the longer side; the input's, at most 2048, unless given
    weights: str | None = None  # an FL-VAE file; the released one unless given
    seed: int = 0  # of the triangulations
    atlases: bool = False  # also write each new row's texture


def quick(path: str | Path = "", name: str = "demo") -> FLDMExperiment:
    """The settings of the demo: a mesh learnt at 5,000 vertices in about 8 minutes on two CPU cores.

    Args:
        path: The mesh file; the embedded vase unless given.
        name: The name of the run's folder.

    Raises ValueError for an asset in memory: a run learns from a file.

    In 1,000 steps the network learns details; motifs come from pieces of the input. Samples of the network
    alone (`flx sample --invention 1`) need 2,400 or more. Velocities and Muon learn more than the paper's
    noise and Adam in so few steps (docs/paper.md). 48 channels where the paper has 96: what two cores can
    train in minutes. float32: bfloat16 is faster only on CPUs with AMX.

    Example:
        flx.train(flx.quick("bowl.glb", name="bowl"))
    """
    if not isinstance(path, str | os.PathLike):
        raise ValueError(
            f"path is {briefly(path)}; give the path of a file, such as one that "
            "flx.to_trimesh(asset).export('mesh.glb') writes"
        )
    return FLDMExperiment(
        name=name,
        model=FLDM(predicts="velocity", draws="lognormal", emphasis=0.5, channels=48, precision="float32"),
        surface=Surface(path=str(path), vertices=5000, copies=8),
        train=Train(
            steps=1000,
            batch=1,
            optimizer="muon",
            learning_rate=1.6e-2,
            final_learning_rate=1e-4,
            warmup=50,
            clip=1.0,
            ema=0.995,
            checkpoint_every=100,
        ),
    )


def read_config(path: Path) -> Experiment:
    """Run an experiment file, with the user's rights, and return its `config`.

    Raises ValueError where there is no such file or it makes no experiment.
    """
    if path.suffix != ".py" or not path.is_file():
        raise ValueError(f"{path} is not a config file; give a Python file such as experiments/demo.py")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    config = getattr(module, "config", None)
    if not isinstance(config, Experiment):
        raise ValueError(f"{path} defines no experiment; add `config = FLDMExperiment(...)` to it")
    return config


def with_added(kind: Any, value: dict[str, Any]) -> dict[str, Any]:
    """The record of an experiment of class `kind`, with the fields that earlier versions lack (`ADDED`)."""
    hints = get_type_hints(kind)
    parts = {
        name: with_added(hints[name], v)
        for name, v in value.items()
        if is_dataclass(hints.get(name)) and isinstance(v, dict)
    }
    return {f.name: ADDED[f.name] for f in fields(kind) if f.name in ADDED} | value | parts


def from_json(kind: Any, value: Any, place: str) -> Any:
    """The value of type `kind` (a dataclass of this module, or the type of a field) that JSON stands for.

    `place` names the value in messages. Raises ValueError for a field that is unknown, missing or of another
    type, and for a number out of its range.
    """
    origin, inner = get_origin(kind), get_args(kind)
    if is_dataclass(kind) and isinstance(value, dict):
        hints = get_type_hints(kind)
        names = {f.name: f.name in ADDED for f in fields(kind)}  # may a record lack it?
        for name in dict.fromkeys([*value, *names]):
            if name not in names or not (name in value or names[name]):
                fault = "has no field" if name in names else "has an unknown field"
                raise ValueError(f"{place} {fault} {name!r}; use the version of flx that made it")
        return kind(**{name: from_json(hints[name], v, f"{place}.{name}") for name, v in value.items()})  # type: ignore[operator]
    if origin in (Union, UnionType):
        for option in inner:
            with contextlib.suppress(ValueError):
                return from_json(option, value, place)
    elif origin is tuple and isinstance(value, list) and len(value) == len(inner):
        return tuple(from_json(k, v, place) for k, v in zip(inner, value, strict=True))
    elif origin is Literal and value in inner:
        return value
    elif kind is float and type(value) is int:
        return float(value)
    elif isinstance(kind, type) and type(value) is kind:
        return value
    raise ValueError(f"{place} is {value!r}, not a {getattr(kind, '__name__', kind)}; correct or delete it")
