"""Assets from arrays and from trimesh, and back: checked, repaired and written as files are."""

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64, Int, Num
from numpy.typing import ArrayLike
from PIL import Image

from flx.arguments import briefly, check_kind
from flx.assets.assemble import FARTHEST, assemble, faults_of
from flx.assets.asset import Asset, Painting, check_asset, check_painting, own_painting
from flx.assets.formats.files import read_file
from flx.assets.formats.images import open_image
from flx.assets.formats.obj import split_corners
from flx.assets.formats.parts import Material, Part, stacked
from flx.assets.formats.readers import Contents
from flx.geometry.color import quantized

if TYPE_CHECKING:
    import trimesh

Shape = tuple[int | str, ...]  # lengths: a number, "N" for any, or "3 or 4"
IMAGE = "base color"  # the name of the image of an asset from arrays


def from_arrays(
    vertices: ArrayLike,
    faces: ArrayLike,
    uvs: ArrayLike | None = None,
    image: ArrayLike | None = None,
    colors: ArrayLike | None = None,
    name: str = "mesh",
) -> Asset:
    """An asset of triangles with an image, or with colours at its vertices, repaired as a file's are.

    Args:
        vertices: Positions, [V, 3].
        faces: Vertices of each triangle, [F, 3], counter-clockwise seen from outside.
        uvs: Texture coordinates of vertices [V, 2] or of corners [F, 3, 2]; they run right and down.
        image: The texture, [H, W, 3 or 4], uint8 or numbers in [0, 1], sRGB; with `uvs`.
        colors: Colours of vertices, [V, 3 or 4], of the same kinds; instead of `uvs` and `image`.
        name: Names the part in files and messages.

    Raises ValueError, naming the row, for shapes, indices and numbers that cannot be used; warns where faces
    are wound against each other.

    Example:
        asset = flx.from_arrays(vertices, faces, uvs, image=np.asarray(Image.open("bowl.png")))
    """
    check_kind("name", name, str, "text, such as 'bowl'")
    points, triangles = _numbers(vertices, "vertices", ("N", 3)), _faces(faces)
    if not len(triangles) or not len(points):
        raise ValueError(f"{len(points)} vertices and {len(triangles)} faces; give at least one triangle")
    _check_rows(points, "vertices")
    if not 0 <= triangles.min() <= triangles.max() < len(points):
        face = int(((triangles < 0) | (triangles >= len(points))).any(1).argmax())
        wanted = f"there are {len(points)} vertices, counted from 0"
        raise ValueError(f"faces[{face}] is {triangles[face].tolist()}, but {wanted}")
    tint = None if colors is None else _colors(colors, "colors", (len(points), "3 or 4"))
    if tint is not None:
        tint = (tint / (255 if tint.dtype == np.uint8 else 1)).astype(np.float32)[:, :3]
    picture = None if image is None else _colors(image, "image", ("N", "N", "3 or 4"))
    if (picture is None) != (uvs is None) or (picture is None and tint is None):
        raise ValueError("give an image together with uvs, or colors")
    rows, coordinates, corners = np.arange(len(points)), None, triangles
    if uvs is not None:
        per_corner = _array(uvs, "uvs", (len(points), 2)).ndim == 3
        coordinates = _numbers(uvs, "uvs", (len(triangles), 3, 2) if per_corner else (len(points), 2))
        _check_rows(coordinates, "uvs")
        if per_corner:
            rows, coordinates, corners = split_corners(triangles, coordinates)
    content = quantized(picture) if picture is not None and picture.dtype != np.uint8 else picture
    white = Material("material", image=None if content is None else IMAGE)
    if content is not None and content.shape[2] == 4:
        white = white._replace(opacity_image=IMAGE)
    part = Part(name, 0, points[rows], None, coordinates, None if tint is None else tint[rows], corners)
    with faults_of(Path(name)):
        contents = Contents([part], [white], lambda _: content)  # pyright: ignore
        asset = assemble(Path(name), contents, format="arrays")
    if count := asset.report.disagreeing_edges:
        warnings.warn(
            f"{name}: at {count:,} edges two faces are wound against each other; the surface is cut there. "
            "Wind all faces counter-clockwise seen from outside (trimesh.repair.fix_winding)",
            stacklevel=2,
        )
    return asset


def _numbers(values: ArrayLike, what: str, shape: Shape) -> Float64[Any, "..."]:
    """The values as float64, in this shape."""
    given = _array(values, what, shape)
    if given.dtype.kind not in "iuf":
        raise ValueError(f"{what} is not an array of numbers (but {given.dtype}); give {_words(shape)}")
    _check_shape(given, what, shape)
    return given.astype(np.float64)


def _array(values: ArrayLike, what: str, shape: Shape) -> np.ndarray:
    """The values as an array. Raises ValueError where their rows differ in length."""
    try:
        return np.asarray(values)
    except (TypeError, ValueError):
        fault = "rows of different lengths"
        raise ValueError(f"{what} is not an array of numbers ({fault}); give {_words(shape)}") from None


def _check_shape(array: Num[Any, "..."], what: str, shape: Shape) -> None:
    pairs = zip(array.shape, map(str, shape), strict=False)
    if array.ndim != len(shape) or not all(w == "N" or str(n) in w.split(" or ") for n, w in pairs):
        raise ValueError(f"{what} has shape {list(array.shape)}; give {_words(shape)}")


def _words(shape: Shape) -> str:
    return f"[{', '.join(map(str, shape))}]"


def _faces(faces: ArrayLike) -> Int[Any, "F 3"]:
    given = _array(faces, "faces", ("N", 3))
    numbers = np.zeros((0, 3)) if given.shape == (0,) else _numbers(given, "faces", ("N", 3))
    whole = np.where(np.abs(numbers) < 2**53, numbers, -0.5).astype(np.int64)
    if (whole != numbers).any():
        face = int((whole != numbers).any(1).argmax())
        raise ValueError(f"faces[{face}] is {numbers[face].tolist()}; give indices of vertices, from 0")
    return whole


def _check_rows(rows: Float64[Any, "..."], what: str) -> None:
    wrong = ~(np.abs(rows) < FARTHEST)
    if wrong.any():
        row = int(np.argwhere(wrong)[0, 0])
        raise ValueError(f"{what}[{row}] is {rows[row].tolist()}; give finite numbers below {FARTHEST:g}")


def _colors(values: ArrayLike, what: str, shape: Shape) -> Num[Any, "..."]:
    """uint8 unchanged, or float64 in [0, 1]."""
    given = _array(values, what, shape)
    if given.dtype == np.uint8 and isinstance(values, np.ndarray):
        _check_shape(given, what, shape)
        numbers = given
    else:
        numbers = _numbers(given, what, shape)
    if not numbers.size:
        raise ValueError(f"{what} has shape {list(numbers.shape)}; give at least one pixel")
    if numbers.dtype == np.uint8:
        return numbers
    wrong = ~(np.abs(numbers - 0.5) <= 0.5)
    if wrong.any():
        raise ValueError(f"{what} has the value {numbers[wrong][0]:g}; give uint8, or numbers from 0 to 1")
    return numbers


def from_trimesh(mesh: "trimesh.Trimesh", name: str = "mesh") -> Asset:
    """The asset of a `trimesh.Trimesh` with a texture, or with colours of vertices or faces.

    Args:
        mesh: Its texture coordinates run up, as trimesh has them.
        name: Names the part in files and messages.

    Raises ValueError where it has no colours, and as `from_arrays` does.

    Example:
        asset = flx.from_trimesh(trimesh.load_mesh("bowl.off"), name="bowl")
    """
    visual: Any = getattr(mesh, "visual", None)
    if visual is None or not hasattr(visual, "kind"):
        raise ValueError(f"mesh is {briefly(mesh)}; give a Trimesh, such as trimesh.load_mesh returns")
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    if visual.kind == "texture":
        material = visual.material
        image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
        if image is None or visual.uv is None:
            raise ValueError("the visual of the mesh has no image or no uv; give both, or vertex colours")
        image = image.convert("RGBA" if image.has_transparency_data else "RGB")
        return from_arrays(vertices, faces, visual.uv * [1, -1] + [0, 1], np.asarray(image), name=name)
    if visual.kind == "face":
        colors, vertices = np.repeat(visual.face_colors, 3, axis=0), vertices[faces].reshape(-1, 3)
        return from_arrays(vertices, np.arange(len(vertices)).reshape(-1, 3), colors=colors, name=name)
    if visual.kind != "vertex":
        raise ValueError("the mesh has no colours; give it a texture, or vertex colours")
    return from_arrays(vertices, faces, colors=visual.vertex_colors, name=name)


def to_trimesh(asset: Asset, painting: Painting | None = None) -> "trimesh.Trimesh":
    """The asset's own triangles, with its own or new colours, as a `trimesh.Trimesh`.

    Args:
        asset: With one texture, or with vertex colours.
        painting: New colours, from `flx.paint` or `flx.generate`; the asset's own unless given.

    Raises ValueError for an asset with more than one texture.

    Example:
        flx.to_trimesh(asset, painting).show()
    """
    import trimesh
    from trimesh.visual import ColorVisuals, TextureVisuals
    from trimesh.visual.material import PBRMaterial

    check_asset("asset", asset)
    if painting is not None:
        check_painting("painting", painting)
    if len(asset.textures) > 1:
        raise ValueError(f"{asset.path} has {len(asset.textures)} textures, a Trimesh one; write a GLB")
    points, faces = stacked(asset.parts)
    mesh = trimesh.Trimesh(points, np.concatenate(faces), process=False)
    painting = own_painting(asset) if painting is None else painting
    if not asset.textures:
        mesh.visual = ColorVisuals(mesh, vertex_colors=quantized(painting.colors))
        return mesh
    image = Image.fromarray(np.asarray(painting.images[0]))
    if (alpha := asset.textures[0].alpha) is not None:
        image.putalpha(Image.fromarray(alpha).resize(image.size, Image.Resampling.BILINEAR))
    uvs = np.concatenate([np.zeros((len(p.positions), 2)) if p.uvs is None else p.uvs for p in asset.parts])
    look = PBRMaterial(baseColorTexture=image, metallicFactor=0.0, roughnessFactor=1.0)
    mesh.visual = TextureVisuals(uv=uvs * [1, -1] + [0, 1], material=look)
    return mesh


def sheet_asset(image: Path) -> Asset:
    """A rectangle that shows the whole image in its proportions. Raises ValueError for an unreadable one."""
    with faults_of(image):
        width, height = open_image(read_file(image), image.name).size
        uvs = np.array([(0, 1), (1, 1), (1, 0), (0, 0)], np.float64)
        points = np.array([(u * width / height, 1 - v, 0) for u, v in uvs])
        part = Part(image.stem, 0, points, None, uvs, None, np.array([(0, 1, 2), (0, 2, 3)]))
        return assemble(image, Contents([part], [Material(image.stem)], lambda _: b""), image)
