"""A depth camera before the visual meshes -> partial point clouds of Scenes: ViewBank. No OpenGL: rays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import trimesh

from conversion.config import ViewConfig
from conversion.model import ConvertedObject, ObjectError
from conversion.raycast import first_triangle
from conversion.scenes import Placement, SceneSpec, placements, rng_of, scene_specs
from conversion.worker_pool import run_tasks
from vatmart_jax.camera import Camera
from vatmart_jax.data.banks import ViewBank
from vatmart_jax.data.part_kinds import PART_KINDS, SLIDE

# The paper's appendix (settings of Where2Act): where the camera stands and what it sees.
DISTANCE = 5.0  # from the object's centre, unit lengths
AZIMUTH = np.pi / 2  # to either side of the front
ELEVATION = np.pi / 6, np.pi / 3
PIXELS = 448
FIELD_OF_VIEW = np.deg2rad(35)  # vertical

MIN_PIXELS = 32  # of the part; a view with fewer is drawn again
TRIES = 20
DIRECTIONS = -1, 1  # for tasks that close the part, and for those that open it


@dataclass(frozen=True, kw_only=True)
class Pixels:
    """What a camera sees of a Scene, one row per pixel that shows the object."""

    points: np.ndarray  # [n, 3] on the visual surface, object frame
    normals: np.ndarray  # [n, 3] unit, towards the camera
    part: np.ndarray  # [n] bool
    handle: np.ndarray  # [n] bool, on a handle of the part


class SceneMesh:
    """The visual surface of one Scene at any joint position of its part."""

    def __init__(self, spec: SceneSpec):
        part = spec.part
        static, own, self.pose = placements(spec)
        self.joint_range, self.kind = part.joint_range, PART_KINDS.get(part.kind)
        self.axis = part.sign * spec.converted.obj.joints[part.link].axis
        self.rest, _ = _triangles(spec.converted, static)
        self.own, self.handle = _triangles(spec.converted, own)
        corners = self.at(0.0).reshape(-1, 3)
        self.centre = (corners.min(axis=0) + corners.max(axis=0)) / 2

    def at(self, q: float) -> np.ndarray:
        """Triangles [m, 3, 3], object frame: first the static ones, then those of the part."""
        move = np.eye(4)
        if self.kind.joint_type == SLIDE:
            move[:3, 3] = q * self.axis
        else:
            move = trimesh.transformations.rotation_matrix(q, self.axis)
        pose = self.pose @ move
        return np.concatenate([self.rest, self.own @ pose[:3, :3].T + pose[:3, 3]])

    def seen(self, camera: Camera, q: float) -> Pixels:
        """Ray by ray: exact points on the triangles, which single-precision ray casting only finds."""
        triangles = self.at(q)
        directions = camera.rays(triangles.reshape(-1, 3), pixels=PIXELS, field_of_view=FIELD_OF_VIEW)
        hit = first_triangle(triangles, camera.position, directions)
        rays, hit = directions[hit >= 0], hit[hit >= 0]
        a, ab, ac = triangles[hit, 0], triangles[hit, 1] - triangles[hit, 0], triangles[hit, 2] - triangles[hit, 0]
        # Möller and Trumbore 1997, in double precision.
        p = np.cross(rays, ac)
        determinant = np.einsum("ij,ij->i", ab, p)
        t = camera.position - a
        s = np.cross(t, ab)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.einsum("ij,ij->i", t, p) / determinant
            v = np.einsum("ij,ij->i", rays, s) / determinant
            distance = np.einsum("ij,ij->i", ac, s) / determinant
        # A ray along a triangle's edge or plane may be found by one precision only.
        inside = (u > -1e-5) & (v > -1e-5) & (u + v < 1 + 1e-5) & (distance > 0)
        hit, rays, distance = hit[inside], rays[inside], distance[inside]
        normals = np.cross(ab[inside], ac[inside])
        normals *= -np.sign(np.einsum("ij,ij->i", normals, rays))[:, None]
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        own = hit - len(self.rest)
        handle = (own >= 0) & self.handle[np.maximum(own, 0)]
        points = camera.position + distance[:, None] * rays
        return Pixels(points=points, normals=normals, part=own >= 0, handle=handle)


def _triangles(converted: ConvertedObject, groups: list[Placement]) -> tuple[np.ndarray, np.ndarray]:
    """Visual triangles [m, 3, 3] of posed groups, and which [m] are a handle's."""
    triangles, handle = [np.zeros((0, 3, 3))], [np.zeros(0, bool)]
    for p in groups:
        for visual in converted.obj.group_visuals(p.group):
            vertices = visual.vertices @ p.pose[:3, :3].T + p.pose[:3, 3]
            triangles.append(vertices[visual.faces])
            handle.append(np.full(len(visual.faces), visual.is_handle))
    return np.concatenate(triangles), np.concatenate(handle)


def render_views(
    objects: Sequence[ConvertedObject], variants: int, seed: int, config: ViewConfig, jobs: int = 1
) -> tuple[ViewBank, list[tuple[int, str]]]:
    """Views of every Scene of the objects, and (Scene, why) of those that have none.

    Scenes are numbered as in `scene_bank` of all `scene_specs(object, variants, seed)`. Each has `config.views` views
    for push tasks and as many for pull tasks, training Scenes `train_factor` times as many. A push view leaves the part
    range to close by a task's goal, a pull view to open. A Scene whose part the camera does not get to see has no
    views. View k of a Scene depends on the seed, its object, part and variant, and k alone. jobs: processes.
    """
    tasks = [(converted, variants, seed, config) for converted in objects]
    found: dict[str, list[ViewBank | str]] = {}
    for (converted, *_), outcome in run_tasks(_object_views, tasks, jobs, label="Rendering"):
        if outcome.error is not None:
            raise ObjectError(f"{converted.obj.id}: not rendered: {outcome.error}")
        found[converted.obj.id] = outcome.value
    rendered = [views for converted in objects for views in found[converted.obj.id]]
    banks = [_bank([], config)]
    for scene, views in enumerate(rendered):
        if isinstance(views, ViewBank):
            banks.append(replace(views, scene=np.full(len(views), scene, np.int32)))
    without = [(scene, why) for scene, why in enumerate(rendered) if isinstance(why, str)]
    return ViewBank.concatenate(banks, [0] * len(banks)), without


def _object_views(converted: ConvertedObject, variants: int, seed: int, config: ViewConfig) -> list[ViewBank | str]:
    """Of every Scene of one object, as Scene 0, its views, or why it has none."""
    out: list[ViewBank | str] = []
    count = config.views * (config.train_factor if converted.split == "train" else 1)
    for spec in scene_specs(converted, variants, seed):
        mesh, rows = SceneMesh(spec), []
        for direction in DIRECTIONS:
            for view in range(count):
                rng = rng_of(seed, converted.obj.id, spec.part.link, spec.variant, int(direction > 0), view)
                rows.append(_draw(rng, mesh, direction, config))
        if any(row is None for row in rows):
            out.append(f"{converted.obj.id} {spec.part.link}: fewer than {MIN_PIXELS} pixels of it in {TRIES} views")
        else:
            out.append(_bank([row for row in rows if row], config))
    return out


@dataclass(frozen=True, kw_only=True)
class _View:
    """One row of a ViewBank."""

    joint_pos: float
    direction: int
    azimuth: float
    elevation: float
    cloud: np.ndarray  # [N] int, its points among the pixels
    touch: np.ndarray  # [C] int, its contacts among the pixels
    pixels: Pixels


def _draw(rng: np.random.Generator, mesh: SceneMesh, direction: int, config: ViewConfig) -> _View | None:
    """One view, or None where the part stays out of sight."""
    low, high = mesh.kind.goal_range
    most = mesh.joint_range
    for _ in range(TRIES):
        goal = rng.uniform(min(low, most), min(high, most))
        q = rng.uniform(0, most - goal) if direction > 0 else rng.uniform(goal, most)
        azimuth, elevation = rng.uniform(-AZIMUTH, AZIMUTH), rng.uniform(*ELEVATION)
        pixels = mesh.seen(Camera.looking_at(mesh.centre, azimuth, elevation, DISTANCE), q)
        part = np.flatnonzero(pixels.part)
        if len(part) < MIN_PIXELS:
            continue
        # Fewer pixels than asked for come again, after all of them have come once.
        return _View(
            joint_pos=q,
            direction=direction,
            azimuth=azimuth,
            elevation=elevation,
            cloud=np.resize(rng.permutation(len(pixels.points)), config.points),
            touch=np.resize(rng.permutation(part), config.contacts),
            pixels=pixels,
        )
    return None


def _bank(views: Sequence[_View], config: ViewConfig) -> ViewBank:
    n, points, contacts = len(views), config.points, config.contacts
    cloud = [v.pixels.points[v.cloud] for v in views]
    touch = [v.pixels.points[v.touch] for v in views]
    return ViewBank(
        scene=np.zeros(n, np.int32),
        joint_pos=np.array([v.joint_pos for v in views], np.float32),
        direction=np.array([v.direction for v in views], np.int8),
        azimuth=np.array([v.azimuth for v in views], np.float32),
        elevation=np.array([v.elevation for v in views], np.float32),
        points=np.array(cloud, np.float16).reshape(n, points, 3),
        part_mask=np.array([v.pixels.part[v.cloud] for v in views], bool).reshape(n, points),
        contacts=np.array(touch, np.float32).reshape(n, contacts, 3),
        contact_normals=np.array([v.pixels.normals[v.touch] for v in views], np.float32).reshape(n, contacts, 3),
        contact_handle=np.array([v.pixels.handle[v.touch] for v in views], bool).reshape(n, contacts),
    )
