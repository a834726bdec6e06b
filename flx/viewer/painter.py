"""The painter: what its page needs of a mesh, and the files made of what is painted on it.

Labels and masks are painted texel by texel: a number for each, which says its label. Label 0 is that of
texels on which nothing is painted. Directions are strokes, which need no atlas.
"""

import base64
import json
import zlib
from collections.abc import Mapping
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Int, UInt8

from flx.assets.asset import Asset, Texture
from flx.assets.formats.files import read_file
from flx.assets.inspect import coverage
from flx.assets.tints import tinted
from flx.files import write_atomically
from flx.geometry.arrays import distinct_rows
from flx.geometry.atlas import Atlas, atlas_texels
from flx.geometry.color import eight_bits, quantized, resized
from flx.geometry.direction import check_direction
from flx.geometry.joints import Joints, bridges, followers, joints_of, similar
from flx.geometry.labels import MOST, hexadecimal
from flx.geometry.regions import PALETTE
from flx.geometry.render import corner_normals
from flx.pipeline.direction import MOST_BYTES, strokes_of
from flx.pipeline.labels import read_labels
from flx.pipeline.masks import read_mask
from flx.types import TexturedMesh
from flx.viewer.drawings import (
    CHANGE,
    KEEP,
    Drawing,
    Label,
    checked_labels,
    foreign_drawing,
    labels_png,
    own_drawing,
)
from flx.viewer.page import html, url
from flx.viewer.pictures import at_most, jpeg
from flx.viewer.server import Answer, Answers
from flx.viewer.surface import packed as packed_at

Mode = Literal["labels", "keep", "direction"]
SHARPEST = 2048  # pixels on the longer side of a texture that the page shows
REST = "#808080"  # the colour of what is not painted


packed = partial(packed_at, level=1)  # quick: it goes no farther than this machine


class Painter:
    """What the page of a mode asks for. `out` is the file that it saves."""

    mode: Mode
    most = MOST_BYTES  # bytes that the page may send

    def __init__(self, asset: Asset, out: Path, up: Literal["y", "z"] = "y") -> None:
        self.asset, self.out, self.up = asset, out, up
        mesh = tinted(asset, asset.mesh) if asset.textures else asset.mesh
        # Faces that lie together and have the same image are drawn together, and the page counts them so.
        self._cells = _cells(mesh)
        self.order = np.lexsort([self._cells, mesh.face_textures])
        self.saved = ""  # what the file holds, in words, once it is written
        self._shown = mesh

    def answers(self) -> Answers:
        """For `flx.viewer.server`."""
        return {
            ("GET", ""): lambda _: ("text/html; charset=utf-8", self._page()),
            ("GET", "data"): lambda _: ("application/json", json.dumps(self.data()).encode()),
            ("POST", "save"): lambda body: ("text/plain; charset=utf-8", self.save(body).encode()),
        }

    def _page(self) -> bytes:
        libraries, scripts = ("three.min.js", "three-mesh-bvh.min.js"), ("camera.js", "painter.js")
        title = f"{self.asset.path.name} – {self.mode}"
        return html(
            "painter.html", ("page.css", "painter.css"), libraries, scripts, title=title, data={}, served=True
        )

    def data(self) -> dict[str, Any]:
        """The mesh, as JSON holds it: positions from −1 to 1, and `scale` and `offset` back to the file's."""
        mesh, joints = self.asset.mesh, self.joints
        middle = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
        radius = float(np.linalg.norm(mesh.vertices - middle, axis=1).max()) or 1.0
        corners = ((mesh.vertices - middle) / radius)[mesh.faces[self.order]]
        normals = np.rint(corner_normals(mesh)[self.order] * 127).astype(np.int8)
        looks = mesh.corner_uvs if mesh.textures else mesh.corner_colors
        look = distinct_rows(looks[self.order].reshape(len(normals) * 3, -1))[1]
        key = [joints.places[self.order].ravel(), look, *(normals.reshape(-1, 3).T.astype(np.int64) + 128)]
        firsts, rows = distinct_rows(np.stack(key, 1).astype(np.int64))
        kinds = np.stack([self._shown.face_textures, self._cells], 1)[self.order]
        starts = np.flatnonzero(np.r_[True, (kinds[1:] != kinds[:-1]).any(1)])
        counts = np.diff(starts, append=len(kinds))
        pictures = [eight_bits(image) for image in self._shown.textures]
        data = {
            "mode": self.mode,
            "up": self.up,
            "out": self.out.name,
            "scale": radius,
            "offset": middle.tolist(),
            "positions": packed(corners.astype(np.float32)),
            "normals": packed(normals),
            "firsts": packed(firsts.astype(np.uint32)),  # corners that differ, once each
            "rows": packed(rows.astype(np.uint32)),  # and which of them each corner is
            "places": packed(joints.places[self.order]),
            "across": packed(self._renumbered(joints.across)[self.order]),
            "charts": packed(joints.charts[self.order].astype(np.int32)),
            "parts": packed(joints.parts[self.order].astype(np.int32)),
            "groups": [
                {"image": int(image), "start": int(start), "count": int(count)}
                for image, start, count in zip(kinds[starts, 0], starts, counts, strict=True)
            ],
            "pictures": [url("jpeg", jpeg(at_most(picture, SHARPEST), 92)) for picture in pictures],
            "notes": self.notes,
        }
        if mesh.textures:
            data["uvs"] = packed(mesh.corner_uvs[self.order])
        else:
            data["colors"] = packed(quantized(mesh.corner_colors)[self.order])
        return data

    def _renumbered(self, across: Int[Any, "F 3"]) -> Int[Any, "F 3"]:
        """Corners as the page counts them."""
        place = np.argsort(self.order)
        return np.where(across < 0, -1, 3 * place[across // 3] + across % 3).astype(np.int32)

    @cached_property
    def joints(self) -> Joints:
        return joints_of(self.asset.mesh)

    @property
    def notes(self) -> list[str]:
        """What to know of the mesh, in sentences."""
        return []

    def save(self, body: bytes) -> str:
        """Write what the page sends; return what is in the file, in words. Raises ValueError."""
        raise NotImplementedError


class TexelPainter(Painter):
    """Labels, or a mask."""

    def __init__(
        self,
        asset: Asset,
        out: Path,
        mode: Literal["labels", "keep"],
        size: tuple[int, int],
        up: Literal["y", "z"] = "y",
        start: Path | None = None,
    ) -> None:
        """`size`: height and width of the file."""
        super().__init__(asset, out, up)
        self.mode = mode
        height, width = size
        self.most = 2 * height * width + (1 << 16)
        mesh = asset.mesh
        if mode == "keep":
            self.texture = next(n for n, texture in enumerate(asset.textures) if not texture.flat)
        else:  # one image for all materials, read at the same texture coordinates
            self.texture = 0
            blank = np.broadcast_to(np.uint8(0), (height, width, 3))
            mesh = mesh.with_layer(images=(blank,), face_images=np.zeros(len(mesh.faces), np.int64))
        self.sheet: TexturedMesh = mesh
        self.atlas: Atlas = atlas_texels(mesh, self.texture, height, width)
        self.drawing = self._started(start)

    def _started(self, start: Path | None) -> Drawing:
        shape = self.atlas.faces.shape
        if self.mode == "keep":
            white = np.zeros(shape, bool) if start is None else read_mask(start, shape)
            return Drawing((CHANGE, KEEP), white.astype(np.uint8))
        if start is None:
            first = Label("label 1", hexadecimal(PALETTE[0]))
            return Drawing((Label("rest", REST), first), np.zeros(shape, np.uint8))
        drawing = own_drawing(start) or foreign_drawing(start, self.asset)
        rows, columns = (
            ((np.arange(new) + 0.5) * old / new).astype(int)
            for new, old in zip(shape, drawing.numbers.shape, strict=True)
        )
        return drawing._replace(numbers=drawing.numbers[rows[:, None], columns])

    def answers(self) -> Answers:
        return {**super().answers(), ("POST", "similar"): self._similar}

    def data(self) -> dict[str, Any]:
        place = np.argsort(self.order).astype(np.int32)
        faces = self.atlas.faces
        return {
            **super().data(),
            "height": self.atlas.height,
            "width": self.atlas.width,
            "owners": packed(np.where(faces < 0, -1, place[faces])),
            "followers": packed(followers(self.atlas)),
            "paintable": packed((self.sheet.face_textures == self.texture)[self.order].astype(np.uint8)),
            "numbers": packed(self.drawing.numbers),
            "labels": [label._asdict() for label in self.drawing.labels],
            "suggestions": [hexadecimal(color) for color in PALETTE],
            "most": MOST,
        }

    @cached_property
    def notes(self) -> list[str]:
        one = (Texture("", None, False),)
        if self.mode == "labels":
            shared = coverage(self.asset._replace(mesh=self.sheet, sources={"base_color": one}))[1]
        else:
            shared = coverage(self.asset)[1]
        if shared < 0.001:
            return []
        return [f"{shared:.1%} of the texels show several places: what is painted on one shows on the others"]

    def _similar(self, body: bytes) -> Answer:
        """The texels like one that the page names, a bit for each."""
        asked = _json(body)
        start, tolerance = asked.get("texel"), asked.get("tolerance")
        if not isinstance(start, int) or not 0 <= start < self.atlas.faces.size:
            raise ValueError("texel is none of the atlas")
        if not isinstance(tolerance, int | float) or not 0 <= tolerance <= 1:
            raise ValueError("tolerance is not from 0 to 1")
        if self.atlas.faces.ravel()[start] < 0:
            raise ValueError("no face shows that texel")
        found = similar(self.colors, self.atlas, self.joints.charts, self._bridges, start, float(tolerance))
        return "application/octet-stream", zlib.compress(np.packbits(found).tobytes(), 1)

    @cached_property
    def colors(self) -> UInt8[Any, "H W 3"]:
        """The texture, at the size of the atlas: of several, that of the face that a texel shows."""
        shape = self.atlas.faces.shape
        image, shown = np.zeros((*shape, 3), np.uint8), self._shown.face_textures[self.atlas.faces]
        for index, picture in enumerate(self._shown.textures):
            here = self.atlas.covered & (shown == index)
            if here.any():
                image[here] = resized(eight_bits(picture), *shape)[here]
        return image

    @cached_property
    def _bridges(self) -> tuple[Int[Any, "N"], Int[Any, "N"]]:
        return bridges(self.sheet, self.joints, self.atlas)

    def save(self, body: bytes) -> str:
        sent = _json(body)
        labels = (CHANGE, KEEP) if self.mode == "keep" else checked_labels(sent.get("labels"))
        numbers = _unpacked(sent.get("numbers"), self.atlas.faces.shape)
        if numbers.max(initial=0) >= len(labels):
            raise ValueError(f"a texel has label {numbers.max()}, but there are {len(labels)}")
        drawing = Drawing(labels, numbers)
        write_atomically(self.out, labels_png(drawing, self.atlas))
        self.drawing, self.saved = drawing, self._in_words(drawing)
        return self.saved

    def _in_words(self, drawing: Drawing) -> str:
        """The share of the texels that each label has, and what keeps flx from using the file."""
        shown = drawing.numbers[self.atlas.covered]
        counts = np.bincount(shown, minlength=len(drawing.labels)) / max(len(shown), 1)
        each = ", ".join(
            f"{label.name} {share:.1%}" for label, share in zip(drawing.labels, counts, strict=True) if share
        )
        fault = ""
        if self.mode == "labels":
            try:
                found = len(read_labels(self.out, self.asset).palette)
                if found < (counts > 0).sum():
                    fault = f"only {found} labels are large enough to be found again"
            except ValueError as why:
                fault = f"flx train cannot use it yet: {why}"
        elif not counts[1]:
            fault = "nothing is kept yet"
        return each + f"; {fault}" * bool(fault)


class StrokePainter(Painter):
    """Strokes, for a direction."""

    mode = "direction"

    def __init__(
        self, asset: Asset, out: Path, up: Literal["y", "z"] = "y", start: Path | None = None
    ) -> None:
        super().__init__(asset, out, up)
        self.strokes: list[Any] = []
        if start is not None:
            self.strokes = self._checked(read_file(start), str(start))

    def _checked(self, content: bytes, name: str) -> list[Any]:
        """The strokes of a file or a request, as JSON holds them; they lie on the surface."""
        try:
            check_direction(strokes_of(content), self.asset.mesh)
        except ValueError as fault:
            raise ValueError(f"{name}: {fault}") from None
        return json.loads(content)["strokes"]

    def data(self) -> dict[str, Any]:
        return {**super().data(), "strokes": self.strokes, "labels": []}

    def save(self, body: bytes) -> str:
        self.strokes = self._checked(body, self.out.name)
        write_atomically(self.out, (json.dumps({"strokes": self.strokes}) + "\n").encode())
        points = sum(len(stroke["points"]) for stroke in self.strokes)
        self.saved = f"strokes: {len(self.strokes)}, with {points:,} points"
        return self.saved


def _cells(mesh: TexturedMesh) -> Int[Any, "F"]:
    """Faces in cells of about 1,000, numbered by where they lie: of a picture, some are drawn again."""
    places = mesh.vertices[mesh.faces].mean(1)
    low, span = places.min(0), max(float(np.ptp(places, axis=0).max()), 1e-300)
    count = max(1, round((len(places) / 1000) ** 0.5))  # along the longest side
    cells = np.minimum((places - low) / span * count, count - 1).astype(np.int64)
    return cells @ [count * count, count, 1]


def _json(body: bytes) -> Mapping[str, Any]:
    try:
        value = json.loads(body)
    except (ValueError, RecursionError):
        value = None
    if not isinstance(value, dict):
        raise ValueError("the request is no JSON object")
    return value


def _unpacked(text: Any, shape: tuple[int, ...]) -> UInt8[Any, "H W"]:
    """What the page packed: deflated bytes in base64, one for each texel."""
    count = int(np.prod(shape))
    try:
        inflater = zlib.decompressobj()
        content = inflater.decompress(base64.b64decode(text, validate=True), count + 1)
    except (TypeError, ValueError, zlib.error):
        raise ValueError("numbers are not deflated bytes in base64") from None
    if len(content) != count or not inflater.eof:
        raise ValueError(f"numbers are not {count:,} bytes, one for each texel")
    return np.frombuffer(content, np.uint8).reshape(shape)
