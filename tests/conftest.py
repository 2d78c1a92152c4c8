"""Fixtures for every test: three small cabinets made of boxes, and the real objects where they are at hand."""

from __future__ import annotations

import gc
import os
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vatmart_jax.data.banks import HINGE, SLIDE, SceneBank, ViewBank
from vatmart_jax.host_threads import allow_callbacks

allow_callbacks()  # test modules use JAX before they make a physics

# Compiled programs are kept between runs; in the environment, so that commands which tests start keep them too.
_CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "vatmart_jax" / "xla"
jax.config.update("jax_compilation_cache_dir", os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_CACHE)))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)

REAL_OBJECTS = Path(__file__).parents[2] / "shared" / "partnet_mobility"
THICK = 0.02  # of boards
BAR = 0.05  # a handle bar's front stands this far before its panel


@pytest.fixture(scope="module", autouse=True)
def programs_of_one_module():
    """Compiled programs go with their module: each takes memory maps, of which a process has 65,530 on Linux, and XLA
    aborts where there are none left."""
    yield
    jax.clear_caches()
    gc.collect()


@pytest.fixture(scope="module")
def quick_to_compile():
    """For modules whose programs are small and many: XLA leaves most of its optimizations out."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", before)


@pytest.fixture(scope="session")
def real_objects() -> Path:
    """The folder of real PartNet-Mobility objects and splits.json; skips where it is absent."""
    if not (REAL_OBJECTS / "splits.json").is_file():
        pytest.skip("no real objects beside the checkout")
    return REAL_OBJECTS


@pytest.fixture(scope="session")
def cabinets() -> tuple[SceneBank, ViewBank]:
    """Six Scenes: a hinged door above and a drawer below, both with bar handles, in three cabinets of two categories.

    Scenes 2i and 2i + 1 are cabinet i's door and drawer. Cabinets differ in size, hinge side, number of boxes and part
    frame. Of every view's 16 contacts, on front faces, the first 8 lie on the panel and the others on the handle.
    """
    objects = [
        Cabinet("100", "StorageFurniture", "train", (0.40, 0.60, 0.70), 1, 0, (0.0, 0.0, 0.0), 3),
        Cabinet("200", "StorageFurniture", "test_shapes", (0.50, 0.90, 1.00), -1, 2, (0.0, 0.0, 1.1), 1),
        Cabinet("300", "Safe", "test_categories", (0.36, 0.50, 0.60), -1, 1, (np.pi, 0.0, 0.3), 2),
    ]
    return scene_bank(objects), view_bank(objects)


@dataclass(frozen=True)
class Box:
    """An axis-aligned box, object frame, with its part closed."""

    centre: np.ndarray  # [3]
    half: np.ndarray  # [3]
    handle: bool = False


@dataclass(frozen=True)
class Part:
    """A door or drawer, closed; the front points towards -x."""

    joint_type: int
    boxes: tuple[Box, ...]  # panel first; the handle's bar last
    anchor: np.ndarray  # [3] on the joint's axis
    axis: np.ndarray  # [3] object frame, opens
    width: float

    def moved(self, points: np.ndarray, q: float) -> np.ndarray:
        """Points [n, 3] of the closed part, opened by q."""
        if self.joint_type == SLIDE:
            return points + q * self.axis
        return Rotation.from_rotvec(q * self.axis).apply(points - self.anchor) + self.anchor

    def turned(self, directions: np.ndarray, q: float) -> np.ndarray:
        """Directions [n, 3] of the closed part, opened by q."""
        return directions if self.joint_type == SLIDE else Rotation.from_rotvec(q * self.axis).apply(directions)


@dataclass(frozen=True)
class Cabinet:
    """A cabinet with a door in its upper half and a drawer in its lower half."""

    object_id: str
    category: str
    split: str
    size: tuple[float, float, float]  # depth, width, height
    side: int  # the hinge is at y = side * width / 2
    shelves: int
    frame: tuple[float, float, float]  # Euler angles of the part frames
    views: int  # per Scene, task sense and opening

    def boards(self) -> list[Box]:
        d, w, h = self.size
        t = THICK / 2
        flat = lambda z: _box((0, 0, z), (d / 2, w / 2, t))
        walls = [_box((0, y, 0), (d / 2, t, h / 2)) for y in (-w / 2 + t, w / 2 - t)]
        shelves = [flat(h / 2 * (k + 1) / (self.shelves + 1)) for k in range(self.shelves)]
        back = _box((d / 2 - t, 0, 0), (t, w / 2, h / 2))
        return [back, *walls, flat(-h / 2 + t), flat(0), flat(h / 2 - t), *shelves]

    def door(self) -> Part:
        d, w, h = self.size
        front = -d / 2 - THICK
        panel = _box((front + THICK / 2, 0, h / 4), (THICK / 2, w / 2, h / 4))
        handle = _handle(front, -self.side * (w / 2 - 0.06), h / 4, np.array([0, 0, 1]))
        axis = np.array([0, 0, -float(self.side)])
        return Part(HINGE, (panel, *handle), np.array([-d / 2, self.side * w / 2, 0.1]), axis, np.pi / 2)

    def drawer(self) -> Part:
        d, w, h = self.size
        front = -d / 2 - THICK
        panel = _box((front + THICK / 2, 0, -h / 4), (THICK / 2, w / 2, h / 4))
        tray = _box((0, 0, -h / 2 + 2.5 * THICK), (d / 2 - THICK, w / 2 - 2 * THICK, THICK / 2))
        handle = _handle(front, 0.0, -h / 4, np.array([0, 1, 0]))
        return Part(SLIDE, (panel, tray, *handle), np.array([0.0, 0, -h / 4]), np.array([-1.0, 0, 0]), 0.9 * d)


def _box(centre, half, handle: bool = False) -> Box:
    return Box(np.array(centre, float), np.array(half, float), handle)


def _handle(front: float, y: float, z: float, along: np.ndarray) -> list[Box]:
    """Two posts and a thin bar before the plane x = front."""
    thin = 0.0075
    ends = [np.array([front - BAR / 2 + thin, y, z]) + 0.05 * s * along for s in (-1, 1)]
    posts = [_box(end, (BAR / 2 - thin, thin, thin), True) for end in ends]
    return [*posts, _box((front - BAR + thin, y, z), thin + 0.0525 * along, True)]


def scene_bank(objects: list[Cabinet]) -> SceneBank:
    hulls: dict[bytes, int] = {}
    vertices, rows, static_count, part_count, scenes = [], [], [], [], []
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)

    def instance(box: Box, origin: np.ndarray, frame: Rotation) -> tuple:
        half = box.half.astype(np.float32)
        shape = hulls.setdefault(half.tobytes(), len(hulls))
        if shape == len(vertices):
            vertices.append(corners * half)
        return shape, frame.inv().apply(box.centre - origin), frame.inv().as_quat(scalar_first=True), box.handle

    statics, parts = [], []
    for cabinet in objects:
        frame = Rotation.from_euler("xyz", cabinet.frame)
        for name, part, other in (
            ("door", cabinet.door(), cabinet.drawer()),
            ("drawer", cabinet.drawer(), cabinet.door()),
        ):
            own = [instance(box, np.zeros(3), Rotation.identity()) for box in (*cabinet.boards(), *other.boxes)]
            moving = [instance(box, part.anchor, frame) for box in part.boxes]
            statics += own
            parts += moving
            static_count.append(len(own))
            part_count.append(len(moving))
            quat = frame.as_quat(scalar_first=True)
            scenes.append((cabinet, name, part, part.anchor, quat, frame.inv().apply(part.axis)))
    rows = statics + parts
    column = lambda f, dtype=None: np.array([f(*scene) for scene in scenes], dtype)
    return SceneBank(
        collision="hull",
        hull_vertices=np.concatenate(vertices),
        hull_start=np.arange(0, 8 * len(vertices) + 1, 8, dtype=np.int32),
        box_size=np.zeros((0, 3), np.float32),
        instance_shape=np.array([r[0] for r in rows], np.int32),
        instance_pos=np.array([r[1] for r in rows]),
        instance_quat=np.array([r[2] for r in rows]),
        instance_handle=np.array([r[3] for r in rows]),
        static_start=np.cumsum([0, *static_count]).astype(np.int32),
        part_start=(len(statics) + np.cumsum([0, *part_count])).astype(np.int32),
        object_id=column(lambda c, *_: c.object_id),
        category=column(lambda c, *_: c.category),
        split=column(lambda c, *_: c.split),
        part=column(lambda _, name, *rest: name),
        joint=column(lambda _, name, *rest: f"joint_{name}"),
        variant=np.zeros(len(scenes), np.int32),
        part_kind=column(lambda _, name, *rest: name),
        joint_type=column(lambda c, n, part, *_: part.joint_type, np.int32),
        part_pos=column(lambda c, n, p, pos, quat, axis: pos, float),
        part_quat=column(lambda c, n, p, pos, quat, axis: quat, float),
        axis=column(lambda c, n, p, pos, quat, axis: axis, float),
        joint_range=column(lambda c, n, part, *_: part.width, float),
        urdf_closed=np.zeros(len(scenes)),
        urdf_sign=np.ones(len(scenes)),
    )


def view_bank(objects: list[Cabinet]) -> ViewBank:
    rng = np.random.default_rng(0)
    views = []
    for index, cabinet in enumerate(objects):
        for scene, part in ((2 * index, cabinet.door()), (2 * index + 1, cabinet.drawer())):
            for opening in (False, True):
                for k in range(cabinet.views):
                    share = (0.1 if opening else 0.6) + 0.1 * k
                    views.append(_view(rng, scene, cabinet, part, opening, share * part.width))
    types = {
        "scene": np.int32, "joint_pos": np.float32, "direction": np.int8, "azimuth": np.float32,
        "elevation": np.float32, "points": np.float16, "part_mask": bool, "contacts": np.float32,
        "contact_normals": np.float32, "contact_handle": bool,
    }  # fmt: skip
    return ViewBank(**{name: np.stack([view[name] for view in views]).astype(dtype) for name, dtype in types.items()})


def _view(rng, scene: int, cabinet: Cabinet, part: Part, opening: bool, q: float) -> dict:
    """One row of a ViewBank: 64 points, half of them on the panel, and 16 contacts."""

    def front(box: Box, n: int, margin: float) -> np.ndarray:
        points = box.centre + rng.uniform(-1, 1, (n, 3)) * (box.half - margin)
        points[:, 0] = box.centre[0] - box.half[0]
        return points

    panel, bar, back = part.boxes[0], part.boxes[-1], cabinet.boards()[0]
    along = bar.half == bar.half.max()
    held = bar.centre + np.where(along, rng.uniform(-0.03, 0.03, (8, 1)), 0.0) - [bar.half[0], 0, 0]
    contacts = part.moved(np.concatenate([front(panel, 8, 0.08), held]), q)
    points = np.concatenate([part.moved(front(panel, 32, 0.0), q), front(back, 32, 0.0)])
    order, outward = rng.permutation(64), np.array([[-1.0, 0, 0]])
    contact_normals = np.repeat(part.turned(outward, q), 16, 0)
    mask = order < 32
    azimuth, elevation = rng.uniform(-1, 1), rng.uniform(0.5, 1.0)
    return {
        "scene": scene, "joint_pos": q, "direction": 1 if opening else -1, "azimuth": azimuth, "elevation": elevation,
        "points": points[order], "part_mask": mask, "contacts": contacts, "contact_normals": contact_normals,
        "contact_handle": np.arange(16) >= 8,
    }  # fmt: skip
