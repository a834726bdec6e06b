"""What guides new textures: `Controls` for any, `Patches` for those without training."""

from dataclasses import dataclass
from pathlib import Path

from flx.arguments import number, path_of, whole
from flx.config import check_all

INVENTION = 0.2  # share of the noise schedule that the network decides, unless given
DIRECTIONS = "x, y, z, curvature, or a JSON file of strokes"


@dataclass(frozen=True)
class Controls:
    """What guides new textures; by default nothing does."""

    strength: float = 1.0  # how far from the input: 0.3 changes details, 1 makes everything new
    # how much the network invents: motifs come from pieces of the input, and it draws them anew at so large
    # a share of its noise; 1 is the network alone. 0.2, unless given
    invention: float | None = None
    keep: Path | None = None  # a mask as large as the texture: what is white stays as it is, to the bit
    fill: Path | None = None  # the same the other way round: what is white becomes new
    mesh: Path | None = None  # another mesh file to paint; it needs no texture
    scale: float = 1.0  # size of details: 2 makes them twice as large, 0.5 half as large
    # what goes where: an image of flat colours on the UVs of the mesh; those that a run learnt, or, with
    # --instant, those of --input-labels
    labels: Path | None = None
    # which way the texture runs, with --instant or for a run that learnt it: x, y, z, curvature, or a JSON
    # file of strokes
    direction: str | None = None
    # pieces of the input stay at their height along this axis, x, y or z: a rim stays a rim, a foot a foot
    height: str | None = None
    rotate: float = 0.0  # degrees by which the direction is turned, counter-clockwise seen from outside
    # weight of labels, direction and height: 0 ignores them, 1 follows them, more exaggerates
    guidance: float = 1.0

    def __post_init__(self) -> None:
        check_all("controls", self, guidance=0)
        for name in ("keep", "fill", "mesh", "labels"):
            if (path := getattr(self, name)) is not None:
                object.__setattr__(self, name, path_of(name, path, "the name of a file"))
        if self.direction is not None:
            given = path_of("direction", self.direction, DIRECTIONS)
            object.__setattr__(self, "direction", str(given))
        if self.keep and self.fill:
            raise ValueError(f"keep is {self.keep} and fill {self.fill}; give one, each says what both would")
        if not 0 < self.scale < float("inf"):
            raise ValueError(f"scale is {self.scale}; give a number more than 0, such as 2")
        if self.mesh is not None and self.strength < 1:
            raise ValueError(f"strength is {self.strength}; leave it out for another mesh, {self.mesh}")
        if self.mesh is not None and (mask := self.keep or self.fill):
            raise ValueError(f"mask {mask} is one of the learnt texture; leave it out for another mesh")
        if not 0 < self.strength <= 1:
            raise ValueError(f"strength is {self.strength}; give more than 0 and at most 1")
        if self.invention is not None:
            if not 0 < number("invention", self.invention) <= 1:
                raise ValueError(f"invention is {self.invention}; give more than 0 and at most 1")
            if self.strength < 1:
                said = f"strength is {self.strength} and invention {self.invention}"
                raise ValueError(f"{said}; give one: strength begins with the input, invention with pieces")

        if self.height is not None and self.height not in ("x", "y", "z"):
            raise ValueError(f"height is {self.height}; give the axis that points up: x, y or z")
        if self.height and self.invented == 1:
            said = f"strength is {self.strength}" if self.strength < 1 else "invention is 1"
            raise ValueError(
                f"height is {self.height}, but {said}: there are no pieces; leave one of them out"
            )

    @property
    def invented(self) -> float:
        """The share of the noise schedule that the network decides after pieces of the input."""
        if self.strength < 1:
            return 1.0
        return INVENTION if self.invention is None else self.invention


@dataclass(frozen=True)
class Patches:
    """How textures are made of pieces of the input, without training."""

    vertices: int = 5000  # points of the surface where pieces may begin and end
    coherence: float = 1.0  # size of the pieces: 0 chooses at each point alone, more makes them larger
    guide: float = 1.0  # how much rims come from rims and hollows from hollows; 0 does not care
    # with --labels: which label each part of the input has; as --labels says, unless given
    input_labels: Path | None = None
    # with --direction: which way the input runs; as --direction says, unless given
    input_direction: str | None = None

    def __post_init__(self) -> None:
        if self.input_labels is not None:
            object.__setattr__(
                self, "input_labels", path_of("input_labels", self.input_labels, "a file of labels")
            )
        if self.input_direction is not None:
            given = path_of("input_direction", self.input_direction, DIRECTIONS)
            object.__setattr__(self, "input_direction", str(given))
        if whole("vertices", self.vertices, 100) > 200_000:
            raise ValueError(f"vertices is {self.vertices}; give at most 200,000")
        for name in ("coherence", "guide"):
            object.__setattr__(self, name, number(name, getattr(self, name), 0))
