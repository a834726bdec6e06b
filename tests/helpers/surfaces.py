"""Surfaces that tests share: closed and open, even and uneven, sound and broken."""

import igl
import numpy as np
import trimesh
from scipy.spatial import ConvexHull
from scipy.stats import special_ortho_group

from flx.types import Layer, TexturedMesh, Triangulation

_PHI = (1 + 5**0.5) / 2
_CORNERS = (
    """-1 φ 0  1 φ 0  -1 -φ 0  1 -φ 0  0 -1 φ  0 1 φ  0 -1 -φ  0 1 -φ  φ 0 -1  φ 0 1  -φ 0 -1  -φ 0 1"""
)
_FACES = """
    0 11 5   0 5 1   0 1 7   0 7 10  0 10 11  1 5 9   5 11 4  11 10 2  10 7 6  7 1 8
    3 9 4    3 4 2   3 2 6   3 6 8   3 8 9    4 9 5   2 4 11  6 2 10   8 6 7   9 8 1"""


def icosphere(subdivisions: int) -> Triangulation:
    """A unit sphere of 10·4ⁿ + 2 vertices: 12, 42, 162, 642, 2,562."""
    vertices = np.array([float(a) for a in _CORNERS.replace("φ", str(_PHI)).split()]).reshape(-1, 3)
    faces = np.array([int(a) for a in _FACES.split()]).reshape(-1, 3)
    vertices = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    for _ in range(subdivisions):
        corners = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        edges, which = np.unique(np.sort(corners, 1), axis=0, return_inverse=True)
        middles = vertices[edges].sum(1)
        ab, bc, ca = which.reshape(-1, 3).T + len(vertices)
        a, b, c = faces.T
        vertices = np.concatenate([vertices, middles / np.linalg.norm(middles, axis=1, keepdims=True)])
        quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        faces = np.concatenate([np.stack(q, 1) for q in quarters])
    return Triangulation(vertices, faces)


def grid_faces(
    rows: int, columns: int, seed: int | None = None, close_rows: bool = False, close_columns: bool = False
) -> np.ndarray:
    """Squares cut along one diagonal, or along either at random; vertex (r, c) is r·columns + c."""
    r, c = np.meshgrid(
        np.arange(rows - (not close_rows)), np.arange(columns - (not close_columns)), indexing="ij"
    )
    r, c = r.ravel(), c.ravel()
    up, right = (r + 1) % rows, (c + 1) % columns
    corners = np.stack([r * columns + c, up * columns + c, up * columns + right, r * columns + right], axis=1)
    if seed is not None:
        turned = np.random.default_rng(seed).random(len(corners)) < 0.5
        corners[turned] = np.roll(corners[turned], -1, axis=1)
    return np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])


def torus(
    around: int = 24, across: int = 12, radius: float = 1.0, tube: float = 0.4, seed: int | None = None
) -> Triangulation:
    """Genus one, `around`·`across` vertices: of degree six, or with a seed jittered and cut either way."""
    u, v = np.meshgrid(np.arange(around), np.arange(across), indexing="ij")
    if seed is not None:
        rng = np.random.default_rng(seed)
        u, v = u + rng.uniform(-0.2, 0.2, u.shape), v + rng.uniform(-0.2, 0.2, v.shape)
    theta, phi = 2 * np.pi * u / around, 2 * np.pi * v / across
    ring = radius + tube * np.cos(phi)
    vertices = np.stack([ring * np.cos(theta), ring * np.sin(theta), tube * np.sin(phi)], -1).reshape(-1, 3)
    return Triangulation(vertices, grid_faces(around, across, seed, True, True))


def uneven_torus(seed: int) -> Triangulation:
    """Closed, χ = 0, no two edges alike."""
    return torus(20, 12, seed=seed)


def square_grid(side: int) -> Triangulation:
    """The flat unit square of `side`² vertices, seen from +z: an open surface, its frames all parallel."""
    steps = np.linspace(0.0, 1.0, side)
    x, y = np.meshgrid(steps, steps, indexing="ij")
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(side * side)], 1)
    return Triangulation(vertices, grid_faces(side, side))


def hull(points: np.ndarray) -> Triangulation:
    """The convex hull of points of which none lies inside, facing outwards."""
    faces = ConvexHull(points).simplices.astype(np.int64)
    a, b, c = (points[faces[:, k]] for k in range(3))
    outwards = a - points.mean(0)  # of the hull's inside; few points may all lie to one side of the origin
    inward = (np.cross(b - a, c - a) * outwards).sum(1) < 0
    faces[inward] = faces[inward][:, ::-1]
    return Triangulation(points, faces)


def random_sphere(count: int, seed: int = 0) -> Triangulation:
    """The convex hull of `count` random points of the unit sphere."""
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return hull(points / np.linalg.norm(points, axis=1, keepdims=True))


def uneven_sphere(seed: int, count: int = 300) -> Triangulation:
    """The convex hull of jittered spiral points: closed, χ = 2, no two edges alike."""
    rng = np.random.default_rng(seed)
    height = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (1 + 5**0.5) * np.arange(count)
    radius = np.sqrt(1 - height**2)
    points = np.stack([np.cos(turn) * radius, np.sin(turn) * radius, height], axis=1)
    points += rng.normal(size=points.shape) * 0.5 / np.sqrt(count)
    return hull(points / np.linalg.norm(points, axis=1, keepdims=True))


def ellipsoid(subdivisions: int = 2) -> Triangulation:
    """An octahedron, subdivided and blown up: 8 · 4ⁿ faces."""
    vertices = np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1.0)])
    around = np.array([(0, 2), (2, 1), (1, 3), (3, 0)])
    faces = np.concatenate([np.insert(around, 2, 4, 1), np.insert(around[:, ::-1], 2, 5, 1)])
    for _ in range(subdivisions):
        vertices, faces = igl.upsample(vertices, faces)
    vertices = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    return Triangulation(vertices * [1.0, 1.3, 0.8], faces.astype(np.int64))


def box(*extents: float) -> Triangulation:
    mesh = trimesh.creation.box(extents).subdivide_to_size(max(extents) / 8)
    return Triangulation(np.array(mesh.vertices, float), np.array(mesh.faces, np.int64))


def globe() -> Triangulation:
    """A sphere of 160 meridians: needles that meet in two poles."""
    mesh = trimesh.creation.uv_sphere(count=[40, 80])
    return Triangulation(np.array(mesh.vertices, float), np.array(mesh.faces, np.int64))


def both(first: Triangulation, second: Triangulation, apart: float = 100) -> Triangulation:
    """Two components."""
    points = np.concatenate([first.vertices, second.vertices + apart])
    return Triangulation(points, np.concatenate([first.faces, second.faces + len(first.vertices)]))


def sheet(seed: int, rows: int = 15, columns: int = 13, jitter: float = 0.2) -> Triangulation:
    """A flat open sheet; the vertices of its middle row lie on one line, x = 0."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(rows) - rows // 2, np.arange(columns), indexing="ij")
    across = rng.uniform(-jitter, jitter, x.shape) * (x != 0)
    along = rng.uniform(-jitter, jitter, y.shape)
    points = np.stack([(x + across).ravel(), (y + along).ravel(), np.zeros(x.size)], axis=1)
    return Triangulation(points, grid_faces(rows, columns, seed))


def bump(seed: int) -> Triangulation:
    """An open sheet with a hill."""
    flat = sheet(seed)
    points = flat.vertices.copy()
    points[:, 2] = 3 * np.exp(-((points[:, :2] - points[:, :2].mean(axis=0)) ** 2).sum(axis=1) / 8)
    return Triangulation(points, flat.faces)


def folded(flat: Triangulation, angle: float = 1.9) -> Triangulation:
    """A flat sheet bent along its edges on the line x = 0."""
    points = flat.vertices.copy()
    bent = points[:, 0] > 0
    points[bent, 2] = points[bent, 0] * np.sin(angle)
    points[bent, 0] *= np.cos(angle)
    return Triangulation(points, flat.faces)


def moved(mesh: Triangulation, seed: int, scale: float = 1.0) -> Triangulation:
    rotation = special_ortho_group.rvs(3, random_state=seed)
    shift = np.random.default_rng(seed).normal(size=3)
    return Triangulation(scale * mesh.vertices @ rotation.T + shift, mesh.faces)


def square_with_hole():
    """A unit square of 20 x 20 cells without its middle 6 x 6."""
    grid = np.arange(21 * 21).reshape(21, 21)
    x, y = np.divmod(np.arange(21 * 21), 21)
    i, j = (k.ravel() for k in np.meshgrid(np.arange(20), np.arange(20), indexing="ij"))
    solid = (np.abs(i - 9.5) > 3) | (np.abs(j - 9.5) > 3)
    i, j = i[solid], j[solid]
    a, b, c, d = grid[i, j], grid[i + 1, j], grid[i + 1, j + 1], grid[i, j + 1]
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    used, index = np.unique(faces, return_inverse=True)
    return Triangulation(np.stack([x, y, 0 * x], 1)[used] / 20.0, index.reshape(-1, 3))


def soup(points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every face with corners of its own."""
    return points[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3)


BLUE, RED = np.array([0.1, 0.2, 0.9], np.float32), np.array([0.9, 0.3, 0.1], np.float32)
DEPTH = 16


def sleeve(thickness: float, around: int = 48) -> TexturedMesh:
    """A cup without a bottom, radius 1, depth 1.6: blue inside, red outside, its walls joined at the rim."""
    rows = 2 * DEPTH + 1
    row, column = np.divmod(np.arange(rows * around), around)
    radius, turn = 1 + thickness / 2 * np.sign(row - DEPTH), column * 2 * np.pi / around
    points = np.stack([radius * np.cos(turn), radius * np.sin(turn), -0.1 * np.abs(row - DEPTH)], axis=1)
    faces = grid_faces(rows, around, close_columns=True)
    a, b, c = points[faces.transpose()]
    outward = (np.cross(b - a, c - a)[:, :2] * a[:, :2]).sum(1) > 0
    if outward[row[faces].max(1) < DEPTH].any():
        faces = faces[:, ::-1]
    inside = row[faces].min(1) < DEPTH
    colors = np.where(inside[:, None, None], BLUE, RED).repeat(3, 1).astype(np.float32)
    return TexturedMesh(
        points,
        faces,
        {"base_color": Layer((), np.zeros(len(faces), np.int64), np.zeros((*faces.shape, 2)))},
        colors,
    )


def moebius(around: int = 60, across: int = 8) -> tuple[np.ndarray, np.ndarray]:
    u, t = np.divmod(np.arange(around * (across + 1)), across + 1)
    turn, side = 2 * np.pi * u / around, (t / across - 0.5) * 0.8
    ring = 1 + side * np.cos(turn / 2)
    points = np.stack([ring * np.cos(turn), ring * np.sin(turn), side * np.sin(turn / 2)], 1)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(around), np.arange(across), indexing="ij"))

    def at(i, j):
        return np.where(i < around, i * (across + 1) + j, across - j)

    a, b, c, d = at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)
    return points, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def three_touching_boxes() -> tuple[np.ndarray, np.ndarray]:
    """Two share an edge, the third a corner."""
    cube = box(1.0, 1.0, 1.0)
    count = len(cube.vertices)
    points = np.concatenate([cube.vertices, cube.vertices + np.array([1, 1, 0]), cube.vertices - 1])
    return points, np.concatenate([cube.faces + k * count for k in range(3)])


def bumpy(subdivisions: int, height: float = 0.15) -> Triangulation:
    """A sphere of smooth bumps; a coarser one has the first vertices of a finer one."""
    points, faces = icosphere(subdivisions)
    bumps = np.sin(5 * points[:, 0]) * np.sin(4 * points[:, 1] + 1) * np.sin(3 * points[:, 2] + 2)
    return Triangulation(points * (1 + height * bumps[:, None]), faces)


def rough(seed: int, noise: float = 0.06) -> Triangulation:
    """A sphere of 162 vertices that are off at random, too little for a crease."""
    points, faces = icosphere(2)
    shift = np.random.default_rng(seed).uniform(-noise, noise, points.shape)
    return Triangulation(points + shift, faces)


def thickened(sheet: Triangulation, thickness: float) -> Triangulation:
    """An open sheet with a back, and walls along its boundary."""
    points, faces = sheet
    outward = igl.per_vertex_normals(points, faces) * thickness / 2
    sides = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    here, back = (set(map(tuple, edges.tolist())) for edges in (sides, sides[:, ::-1]))
    a, b = np.array(sorted(here - back)).T
    count = len(points)
    walls = [np.stack([b, a, a + count], 1), np.stack([b, a + count, b + count], 1)]
    return Triangulation(
        np.concatenate([points + outward, points - outward]),
        np.concatenate([faces, faces[:, ::-1] + count, *walls]),
    )


def basket(around: int = 24, up: int = 8, bar: int = 4, hole: int = 4, thickness: float = 0.012):
    """A woven band of bars, `bar` cells wide, around `around` · `up` holes: χ is −2 · `around` · `up`."""
    rows, columns = around * (bar + hole), up * (bar + hole) + bar + 1
    row, column = np.divmod(np.arange(rows * columns), columns)
    turn, height = 2 * np.pi * row / rows, column / (columns - 1)
    weave = [np.cos(np.pi * (cell - bar / 2) / (bar + hole)) for cell in (row, column)]
    radius = 0.5 + 0.15 * height + 0.02 * weave[0] * weave[1]
    points = np.stack([radius * np.cos(turn), radius * np.sin(turn), height], 1)
    r, c = (k.ravel() for k in np.meshgrid(np.arange(rows), np.arange(columns - 1), indexing="ij"))
    solid = np.minimum(r % (bar + hole), c % (bar + hole)) < bar
    faces = grid_faces(rows, columns, close_rows=True)[np.tile(solid, 2)]
    used, index = np.unique(faces, return_inverse=True)
    return thickened(Triangulation(points[used], index.reshape(-1, 3)), thickness)
