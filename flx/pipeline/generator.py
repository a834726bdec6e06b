"""A trained model as one object, stored in one file; it makes new codes of a surface.

The file is a safetensors with nothing executable in it: averaged weights and complete configuration of the
network, latent scaling, the FL-VAE, the files of the asset that it learnt from, and one triangulated copy of
it, with its labels and its direction if it has any. Using it needs neither the optimiser nor the run folder
nor the other copies of the training.
"""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from jax.tree_util import Partial
from jaxtyping import Complex64, Complex128, Float64, Int32

from flx import __version__
from flx.arguments import number, whole
from flx.assets.asset import Asset
from flx.assets.formats.files import inside
from flx.assets.read import read_asset, read_with_maps
from flx.config import FLDM, FLVAE, STEPS, FLDMExperiment, Sampler, from_json
from flx.fields import samplers
from flx.fields.algebra import tangent_noise
from flx.fields.diffusion import Scaling, diffuse
from flx.fields.guidance import Condition, guided
from flx.files import temporary_folder, write_atomically
from flx.geometry.labels import LabelMap
from flx.geometry.tables import mesh_tables
from flx.models.denoiser.mixed import MixedDenoiser
from flx.models.denoiser.unet import UNet, denoise, schedule
from flx.models.denoiser.vectors import Denoiser
from flx.pipeline.codec import Codec, initial_params, odd_parameter
from flx.pipeline.labels import Labels, one_hot, read_labels
from flx.pipeline.masks import Kept, read_damage
from flx.pipeline.tensors import load_tensors, one_line, save_tensors
from flx.types import MeshTables, Triangulation


class Home(NamedTuple):
    """A triangulated copy of a mesh, as sampling sees it."""

    triangulation: Triangulation
    tables: MeshTables


class Source(NamedTuple):
    """The files of the asset that a generator learnt from."""

    mesh: str  # its name among `files`
    texture: str | None  # the image that replaces the mesh's own
    digest: str  # of the asset
    files: dict[str, bytes]  # by their path in the asset's folder
    labels: str | None = None  # the name of the file that labels it
    fill: str | None = None  # that of the mask of its damage


@dataclass(frozen=True)
class Generator:
    """What makes new codes of a surface.

    `denoise(params, tables, z, t) → ε̂` finds the noise in z on the tables of a mesh copy; where there are
    labels, it is also given a `Condition`. Any hashable function may stand in for a trained network; it is
    compiled once.
    """

    denoise: Callable[..., jax.Array]
    params: Any
    alphas: Float64[np.ndarray, "T"]  # the noise schedule
    scaling: Scaling
    codec: Codec
    home: Home
    source: Source
    experiment: FLDMExperiment  # as it was trained
    step: int  # steps trained
    labels: Labels | None = None  # those that it learnt
    direction: Complex128[np.ndarray, "V"] | None = None  # the one that it learnt, at home

    def sample(
        self,
        key: jax.Array,
        copy: Any = None,
        steps: int = STEPS,
        sampler: Sampler = "dpm",
        hook: samplers.Hook | None = None,
        near: Complex64[np.ndarray, "V D"] | None = None,
        strength: float = 1.0,
        repeats: tuple[int, int] | None = None,
        labels: Int32[np.ndarray, "V"] | None = None,
        guidance: float = 1.0,
        direction: Complex128[np.ndarray, "V"] | None = None,
    ) -> Complex64[np.ndarray, "V D"]:
        """New codes at the vertices of a copy: anything with `tables`, the generator's own unless given.

        Args:
            key: A JAX random key. Same key, same machine: same bits.
            copy: The triangulation to sample on, from `flx.triangulate`.
            steps: Evaluations of the network; "ancestral" takes all of the schedule instead.
            sampler: "ddim" (deterministic), "dpm" (second order) or "ancestral" (DDPM).
            hook: Called after each step with (z, s, key); its result replaces z. z is scaled (`scaling`).
                A `jax.tree_util.Partial` binds arrays to it; a hook is compiled once, whatever they hold.
            near: Codes on the copy to stay near: sampling starts from these, noised.
            strength: How far it may go from `near`: the share of the schedule, and of the steps, that is
                taken; 1 forgets `near`.
            repeats: Length and times of the stretches of steps that are repeated (`samplers.repeated`).
            labels: The label of each vertex, by its place in `self.labels.palette`. Unless given, the
                generator's own on its own copy, and none on another.
            guidance: Weight of labels and direction: 0 ignores them, 1 follows them, more exaggerates.
            direction: The direction of each vertex in its frame: a unit number, or 0. Unless given, the
                generator's own on its own copy, and none on another.

        Raises ValueError for a sampler that is not known, for more steps than the schedule has, for a
        strength outside (0, 1], and for labels, a direction or guidance where none were learnt.
        """
        if not 0 < strength <= 1:
            raise ValueError(f"strength is {strength}; give more than 0 and at most 1")
        strength = 1.0 if near is None else strength
        chosen = samplers.sampler_named(sampler, self.alphas, steps, strength, repeats)
        tables = jax.tree.map(jnp.asarray, (copy or self.home).tables)
        start, signal = np.zeros((len(tables.fine.masses), self.codec.config.latents), np.complex64), 0.0
        if near is not None and strength < 1:
            start, signal = self.scaling.to_diffusion(near), self.alphas[int(chosen.table["t"][0])]
        if copy is None:
            labels = self.labels.numbers if labels is None and self.labels else labels
            direction = self.direction if direction is None else direction
        condition = self._condition(len(start), labels, guidance, direction)
        rules = (self.denoise, chosen.step, chosen.memory)
        bound = hook if hook is None or isinstance(hook, Partial) else Partial(hook)
        z = _draw(
            *rules, bound, self.params, tables, chosen.table, start, jnp.float32(signal), key, condition
        )
        return self.scaling.to_latents(np.asarray(z))

    def _condition(
        self,
        vertices: int,
        labels: Int32[np.ndarray, "V"] | None,
        guidance: float,
        direction: Complex128[np.ndarray, "V"] | None,
    ) -> Condition | None:
        """What the network sees of labels and direction; None where it learnt neither."""
        if self.direction is None and direction is not None:
            raise ValueError(
                "a direction is given, but none was learnt; train with --surface.direction FIELD"
            )
        if self.labels is None and (labels is not None or (self.direction is None and guidance != 1)):
            what = "labels are given" if labels is not None else f"guidance is {guidance:g}"
            raise ValueError(f"{what}, but none were learnt; train with --surface.labels IMAGE")
        if self.labels is None and self.direction is None:
            return None
        guidance, rho, vectors = number("guidance", guidance, 0), None, None
        if self.labels is not None:
            count = len(self.labels.palette)
            if labels is not None and not _are_numbers(labels, vertices, count):
                raise ValueError(f"labels do not fit; give {vertices} whole numbers from 0 to {count - 1}")
            ignored = labels is None or guidance == 0
            rho = jnp.zeros((vertices, count)) if ignored else jnp.asarray(one_hot(labels, count))
        if self.direction is not None:
            if direction is not None and not _are_directions(direction, vertices):
                raise ValueError(f"direction does not fit; give {vertices} unit complex numbers, or 0")
            ignored = direction is None or guidance == 0
            vectors = jnp.zeros(vertices) if ignored else jnp.asarray(direction)
            vectors = vectors.astype(jnp.complex64)[:, None]
        nothing = labels is None and direction is None
        weight = None if nothing or guidance in (0, 1) else jnp.float32(guidance)
        return Condition(rho, weight, vectors)

    @cached_property
    def labelled(self) -> LabelMap | None:
        """The labels of the asset's surface, None where it has none."""
        if self.labels is None or self.source.labels is None:
            return None
        path = inside(Path(self._folder.name), self.source.labels)
        return read_labels(path, self.asset, self.labels.palette)

    @cached_property
    def intact(self) -> Kept | None:
        """What is intact of the asset's texture, None where no damage was marked."""
        name = self.source.fill
        return read_damage(inside(Path(self._folder.name), name), self.asset) if name else None

    @cached_property
    def asset(self) -> Asset:
        """The asset that it learnt from, read from its own files."""
        return read_asset(*self._files())

    @cached_property
    def asset_with_maps(self) -> Asset:
        """The same asset, with those other maps of its materials that can be read."""
        return read_with_maps(*self._files())._replace(digest=self.asset.digest)

    def _files(self) -> tuple[Path, Path | None]:
        folder, texture = Path(self._folder.name), self.source.texture
        return inside(folder, self.source.mesh), inside(folder, texture) if texture else None

    @cached_property
    def _folder(self) -> TemporaryDirectory[str]:
        """Its files, for as long as it lives: an OBJ copies its maps when it is written."""
        folder = temporary_folder()
        for name, content in self.source.files.items():
            write_atomically(inside(Path(folder.name), name), content)
        return folder


@partial(jax.jit, static_argnums=(0, 1, 2))
def _draw(denoise, step, memory, hook, params, tables, table, near, signal, key, condition):
    """Codes as they are diffused, from `near` and the noise of a key; `signal` is the α of `near`."""
    of_start, of_steps = jax.random.split(key)
    start = diffuse(near, tangent_noise(of_start, near.shape), signal)
    sampler, seen = samplers.Sampler(table, step, memory), () if condition is None else (condition,)
    return samplers.reverse(lambda z, t: denoise(params, tables, z, t, *seen), sampler, start, of_steps, hook)


def _are_numbers(labels: Any, vertices: int, count: int) -> bool:
    """Whether labels are one number for each vertex, from 0 to `count` − 1."""
    labels = np.asarray(labels)
    right = labels.shape == (vertices,) and labels.dtype.kind in "iu"
    return right and bool(((labels >= 0) & (labels < count)).all())


def _are_directions(direction: Any, vertices: int) -> bool:
    """Whether directions are one unit number for each vertex, or 0."""
    direction = np.asarray(direction)
    if direction.shape != (vertices,) or direction.dtype.kind not in "fc":
        return False
    return bool(((np.abs(np.abs(direction) - 1) < 1e-3) | (direction == 0)).all())


# --- a learnt one


class LearntDenoiser(NamedTuple):
    """A trained network as a generator calls it."""

    network: UNet

    def __call__(
        self, params: Any, tables: MeshTables, z: jax.Array, t: jax.Array, condition: Condition | None = None
    ) -> jax.Array:
        noise = partial(denoise, self.network, params, tables, z, t)
        return guided(noise, condition or Condition())


def network_of(model: FLDM) -> UNet:
    """The network of a complete model (see `flx.models.denoiser.depth.complete`)."""
    assert model.blocks is not None
    return (MixedDenoiser if model.network == "mixed" else Denoiser)(model, model.blocks)


def parameter_shapes(model: FLDM, tables: MeshTables) -> Any:
    """Of the network of a complete model: its parameters, as `jax.ShapeDtypeStruct`s."""
    # Tables of one slot will do: no shape depends on them, and tracing is three times faster.
    narrow = jax.tree.map(lambda a: a[:, :1] if a.ndim > 1 else a, tables)
    z = jax.ShapeDtypeStruct((len(tables.fine.masses), model.latents), jnp.complex64)
    rho = jax.ShapeDtypeStruct((z.shape[0], model.conditions), jnp.float32) if model.conditions else None
    shape = (z.shape[0], model.directions)
    direction = jax.ShapeDtypeStruct(shape, jnp.complex64) if model.directions else None
    arguments = narrow, z, jnp.float32(1), rho, direction
    return jax.eval_shape(network_of(model).init, jax.random.key(0), *arguments)


def learnt_generator(
    experiment: FLDMExperiment,
    params: Any,
    scaling: Scaling,
    codec: Codec,
    home: Home,
    source: Source,
    step: int,
    labels: Labels | None = None,
    direction: Complex128[np.ndarray, "V"] | None = None,
) -> Generator:
    """The generator that a trained network makes; `experiment.model` is complete."""
    model = experiment.model
    denoiser = LearntDenoiser(network_of(model))
    alphas = schedule(model)
    learnt = experiment, step, labels, direction
    return Generator(denoiser, params, alphas, scaling, codec, home, source, *learnt)


# --- as a file


def save_generator(path: Path, generator: Generator) -> None:
    """Write a learnt generator as one file, whole or not at all."""
    surface, source = generator.experiment.surface, generator.source
    # Names without folders: the file may be passed on.
    places = {"path": surface.path, "direction": surface.direction, "texture": source.texture}
    places |= {"labels": surface.labels, "fill": surface.fill}
    named = replace(surface, **{name: place and Path(place).name for name, place in places.items()})
    record = {
        "flx": __version__,
        "step": generator.step,
        "experiment": asdict(replace(generator.experiment, surface=named, weights=None)),
        "codec": asdict(generator.codec.config),
        "source": {name: value for name, value in source._asdict().items() if name != "files"},
    }
    vertices, faces = generator.home.triangulation
    tensors = {
        **_flat("network", generator.params["params"]),
        **_flat("codec", generator.codec.params["params"]),
        "scaling": np.stack(generator.scaling).view(np.float32),
        "home/vertices": np.asarray(vertices, np.float64),
        "home/faces": np.asarray(faces, np.int32),
        **{f"asset/{name}": np.frombuffer(content, np.uint8) for name, content in source.files.items()},
    }
    if generator.labels:
        tensors |= {"labels/palette": generator.labels.palette, "labels/numbers": generator.labels.numbers}
    if generator.direction is not None:
        tensors |= {"direction": generator.direction.view(np.float64)}
    save_tensors(path, tensors, "generator", json.dumps(record))


def read_generator(path: Path) -> Generator:
    """Read a file of `save_generator`. Nothing in it is executed.

    Raises ValueError where the file is missing, damaged, or not a generator of this version.
    """
    try:
        text, tensors = load_tensors(path, "generator")
        return _parse(json.loads(text), tensors)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(
            f"{path} cannot be used as a generator ({one_line(error)}); give a run folder of `flx train`, "
            "or the generator.safetensors in it"
        ) from None


def _parse(record: dict[str, Any], tensors: dict[str, np.ndarray]) -> Generator:
    experiment = cast(FLDMExperiment, from_json(FLDMExperiment, record["experiment"], "experiment"))
    config = cast(FLVAE, from_json(FLVAE, record["codec"], "codec"))
    codec = Codec(config, _nested("codec", tensors, jax.eval_shape(lambda: initial_params(config, 0))))
    surface, source = experiment.surface, record["source"]
    shift, scale = tensors["scaling"].view(np.complex64)
    if len(scale) != codec.config.latents:
        raise ValueError(f"scaling of {len(scale)} channels for codes of {codec.config.latents}")
    if not (scale.real * scale.imag).all():
        raise ValueError("scaling is 0 in a channel")
    home = Triangulation(tensors["home/vertices"], tensors["home/faces"].astype(np.int64))
    if not len(home.faces) or not 0 <= home.faces.min() <= home.faces.max() < len(home.vertices):
        raise ValueError("a face of its triangulation names a vertex that is not there")
    tables = mesh_tables(home, surface.slots, surface.seed)
    files = {n.removeprefix("asset/"): t.tobytes() for n, t in tensors.items() if n.startswith("asset/")}
    return learnt_generator(
        experiment,
        _nested("network", tensors, parameter_shapes(experiment.model, tables)),
        Scaling(shift, scale),
        codec,
        Home(home, tables),
        Source(**source, files=files),
        whole("step", record["step"]),
        _labels(tensors, len(home.vertices), experiment.model.conditions),
        _direction(tensors, len(home.vertices)) if experiment.model.directions else None,
    )


def _labels(tensors: dict[str, np.ndarray], vertices: int, count: int) -> Labels | None:
    """Raises ValueError where they do not fit the mesh or the network."""
    if not count:
        return None
    palette, numbers = tensors["labels/palette"], tensors["labels/numbers"]
    shapes = palette.shape, numbers.shape
    if shapes != ((count, 3), (vertices,)) or not 0 <= numbers.min() <= numbers.max() < count:
        raise ValueError(f"labels of {len(numbers)} vertices for {vertices}, {len(palette)} for {count}")
    return Labels(palette, numbers)


def _direction(tensors: dict[str, np.ndarray], vertices: int) -> Complex128[np.ndarray, "V"]:
    """Raises ValueError where it does not fit the mesh."""
    direction = tensors["direction"].view(np.complex128)
    if not _are_directions(direction, vertices):
        raise ValueError(f"its direction is not one of {vertices} vertices")
    return direction


def _flat(prefix: str, params: Any) -> dict[str, np.ndarray]:
    return {f"{prefix}/" + "/".join(name): np.asarray(leaf) for name, leaf in flatten_dict(params).items()}


def _nested(prefix: str, tensors: dict[str, np.ndarray], expected: Any) -> Any:
    """The parameters of a network. Raises ValueError where their names or shapes are not those expected."""
    flat = {n.removeprefix(f"{prefix}/"): t for n, t in tensors.items() if n.startswith(f"{prefix}/")}
    if odd := odd_parameter(flat, expected):
        raise ValueError(
            f"{prefix}/{odd} differs: another version of flx made it; use that version or train anew"
        )
    return {"params": unflatten_dict(jax.tree.map(jnp.asarray, flat), "/")}
