"""A depth camera before the visual meshes -> partial point clouds of Scenes: ViewBank. No OpenGL: rays."""

from __future__ import annotations

import multiprocessing
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, fields

import numpy as np
import trimesh
from rich.console import Console
from rich.progress import Progress
from trimesh.ray.ray_pyembree import RayMeshIntersector

from conversion.partnet import ConvertedObject, ObjectError, Part
from conversion.scenes import Placement, instances, other_values, placements, rng_of
from vatmart_jax.data.banks import HINGE, SLIDE, SceneBank, ViewBank

# The paper's appendix (settings of Where2Act): where the camera stands and what it sees.
DISTANCE = 5.0  # from the object's centre, unit lengths
AZIMUTH = np.pi / 2  # to either side of the front
ELEVATION = np.pi / 6, np.pi / 3
PIXELS = 448
FIELD_OF_VIEW = np.deg2rad(35)  # vertical
# Tasks (section 3 of the paper): how far parts are to move, rad or unit lengths.
TASKS = {HINGE: (np.deg2rad(10), np.deg2rad(70)), SLIDE: (0.1, 0.7)}

MIN_PIXELS = 32  # of the part; a view with fewer is drawn again
TRIES = 20


@dataclass(frozen=True)
class Camera:
    position: np.ndarray  # [3]
    axes: np.ndarray  # [3, 3] rows: right, up, forward

    @classmethod
    def at(cls, centre: np.ndarray, azimuth: float, elevation: float) -> Camera:
        """Looking at `centre` from the direction (azimuth about z from the front -x, elevation), z up."""
        back = np.array([-np.cos(azimuth), -np.sin(azimuth), np.tan(elevation)]) * np.cos(elevation)
        right = np.cross(-back, [0, 0, 1])
        right /= np.linalg.norm(right)
        return cls(centre + DISTANCE * back, np.stack([right, np.cross(back, right), -back]))

    def rays(self, points: np.ndarray) -> np.ndarray:
        """Unit directions [n, 3] through the centres of all pixels in the bounding box of the projected points."""
        p = (points - self.position) @ self.axes.T
        focal = PIXELS / 2 / np.tan(FIELD_OF_VIEW / 2)
        image = focal * p[:, :2] / p[:, 2:]
        low = np.clip(np.floor(image.min(axis=0) + PIXELS / 2), 0, PIXELS).astype(int)
        high = np.clip(np.ceil(image.max(axis=0) + PIXELS / 2), 0, PIXELS).astype(int)
        x, y = np.meshgrid(*(np.arange(a, b) + 0.5 - PIXELS / 2 for a, b in zip(low, high, strict=True)))
        directions = np.stack([x.ravel(), y.ravel(), np.full(x.size, focal)], axis=1) @ self.axes
        return directions / np.linalg.norm(directions, axis=1, keepdims=True)


@dataclass(frozen=True)
class Pixels:
    """What a camera sees of a Scene, one row per pixel that shows the object."""

    points: np.ndarray  # [n, 3] on the visual surface, object frame
    normals: np.ndarray  # [n, 3] unit, towards the camera
    part: np.ndarray  # [n] bool
    handle: np.ndarray  # [n] bool, on a handle of the part


class SceneMesh:
    """The visual surface of one Scene at any opening of its part."""

    def __init__(self, converted: ConvertedObject, part: Part, values: dict[str, float]):
        obj = converted.obj
        self.static, own, self.pose = placements(converted, part, values)
        self.kind, self.axis = part.kind, part.sign * obj.joints[part.link].axis
        self.rest, _ = _triangles(converted, self.static)
        self.own, self.handle = _triangles(converted, own)
        corners = self.at(0.0).reshape(-1, 3)
        self.centre = (corners.min(axis=0) + corners.max(axis=0)) / 2

    def at(self, q: float) -> np.ndarray:
        """Triangles [m, 3, 3], object frame: first the static ones, then those of the part."""
        move = np.eye(4)
        if self.kind == "drawer":
            move[:3, 3] = q * self.axis
        else:
            move = trimesh.transformations.rotation_matrix(q, self.axis)
        pose = self.pose @ move
        return np.concatenate([self.rest, self.own @ pose[:3, :3].T + pose[:3, 3]])

    def seen(self, camera: Camera, q: float) -> Pixels:
        """Ray by ray: exact points on the triangles, which single-precision ray casting only finds."""
        triangles = self.at(q)
        directions = camera.rays(triangles.reshape(-1, 3))
        mesh = trimesh.Trimesh(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3), process=False)
        hit = RayMeshIntersector(mesh).intersects_first(np.broadcast_to(camera.position, directions.shape), directions)
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
        return Pixels(camera.position + distance[:, None] * rays, normals, own >= 0, handle)


def _triangles(converted: ConvertedObject, groups: list[Placement]) -> tuple[np.ndarray, np.ndarray]:
    """Visual triangles [m, 3, 3] of posed groups, and which [m] are a handle's."""
    triangles, handle = [np.zeros((0, 3, 3))], [np.zeros(0, bool)]
    for p in groups:
        for visual in converted.obj.group_visuals(p.group):
            vertices = visual.vertices @ p.pose[:3, :3].T + p.pose[:3, 3]
            triangles.append(vertices[visual.faces])
            handle.append(np.full(len(visual.faces), visual.is_handle))
    return np.concatenate(triangles), np.concatenate(handle)


def views(
    objects: Sequence[ConvertedObject], bank: SceneBank, per_scene: int | np.ndarray, n_points: int, n_contacts: int,
    seed: int, jobs: int,
) -> tuple[ViewBank, list[tuple[int, str]]]:  # fmt: skip
    """Views of every Scene: `per_scene` for push tasks and as many for pull tasks; and (scene, why) of those without.

    per_scene: one for all, or [S], the same for the Scenes of an object. objects: at least those of the bank. seed: the
    one the bank was made with. jobs: processes. A push view leaves the part room to close by a task's length, a pull
    view to open. A Scene whose part the camera does not get to see has no views. View k of a Scene depends on the seed,
    its object, part and variant, and k alone. Raises ObjectError where bank and objects do not belong together.
    """
    by_id = {o.obj.id: o for o in objects}
    work = []
    for object_id in dict.fromkeys(bank.object_id):
        if object_id not in by_id:
            raise ObjectError(f"{object_id}: a Scene of the bank has no object; convert it again")
        scenes = np.flatnonzero(bank.object_id == object_id)
        count = int(np.broadcast_to(per_scene, len(bank))[scenes[0]])
        work.append((by_id[object_id], bank.select(scenes), scenes, count, n_points, n_contacts, seed))
    done: dict[int, ViewBank | str] = {}
    with Progress(console=Console(stderr=True), transient=True) as progress:
        bar = progress.add_task("Rendering", total=len(bank))
        if jobs == 1:
            for task in work:
                done.update(_object_views(*task))
                progress.advance(bar, len(task[2]))
        else:
            # Forking a process that may run JAX's threads is not safe.
            with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
                futures = {pool.submit(_object_views, *task): task for task in work}
                for future in as_completed(futures):
                    done.update(future.result())
                    progress.advance(bar, len(futures[future][2]))
    ordered = [(s, done[s]) for s in sorted(done)]
    empty = _stack([], n_points, n_contacts)
    banks = [empty, *(v for _, v in ordered if isinstance(v, ViewBank))]
    joined = ViewBank(**{f.name: np.concatenate([getattr(b, f.name) for b in banks]) for f in fields(ViewBank)})
    return joined, [(s, v) for s, v in ordered if isinstance(v, str)]


def _object_views(
    converted: ConvertedObject, bank: SceneBank, scenes: np.ndarray, per_scene: int, n_points: int, n_contacts: int,
    seed: int,
) -> dict[int, ViewBank | str]:  # fmt: skip
    """The views of one object's Scenes, by their index in the whole bank, or why there are none."""
    out: dict[int, ViewBank | str] = {}
    parts = {p.link: p for p in converted.parts}
    for k, scene in enumerate(scenes.tolist()):
        part, variant = parts.get(str(bank.part[k])), int(bank.variant[k])
        if part is None:
            raise ObjectError(f"{converted.obj.id}: has no part {bank.part[k]} any more; make the Scenes again")
        values = other_values(converted, part, variant, seed)
        mesh = SceneMesh(converted, part, values)
        rows = slice(bank.static_start[k], bank.static_start[k + 1])
        static = np.array([pos for _, pos, *_ in instances(converted, mesh.static, bank.collision, 0)]).reshape(-1, 3)
        if static.shape != bank.instance_pos[rows].shape or not np.allclose(static, bank.instance_pos[rows]):
            raise ObjectError(f"{converted.obj.id}: its Scenes were made from another version or seed; make them again")
        rows = []
        for opening in (False, True):
            for view in range(per_scene):
                rng = rng_of(seed, converted.obj.id, part.link, variant, int(opening), view)
                rows.append(_draw(rng, mesh, scene, int(bank.joint_type[k]), part.width, opening, n_points, n_contacts))
        if any(row is None for row in rows):
            out[scene] = f"{converted.obj.id} {part.link}: fewer than {MIN_PIXELS} pixels of it in {TRIES} views"
        else:
            out[scene] = _stack([row for row in rows if row], n_points, n_contacts)
    return out


def _draw(
    rng: np.random.Generator, mesh: SceneMesh, scene: int, joint_type: int, width: float, opening: bool, n_points: int,
    n_contacts: int,
) -> tuple | None:  # fmt: skip
    """One row of a ViewBank in the order of its fields, or None where the part stays out of sight."""
    low, high = TASKS[joint_type]
    for _ in range(TRIES):
        task = rng.uniform(min(low, width), min(high, width))
        q = rng.uniform(0, width - task) if opening else rng.uniform(task, width)
        azimuth, elevation = rng.uniform(-AZIMUTH, AZIMUTH), rng.uniform(*ELEVATION)
        pixels = mesh.seen(Camera.at(mesh.centre, azimuth, elevation), q)
        part = np.flatnonzero(pixels.part)
        if len(part) < MIN_PIXELS:
            continue
        # Fewer pixels than asked for come again, after all of them have come once.
        cloud = np.resize(rng.permutation(len(pixels.points)), n_points)
        touch = np.resize(rng.permutation(part), n_contacts)
        return (
            scene, q, opening, azimuth, elevation, pixels.points[cloud], pixels.normals[cloud], pixels.part[cloud],
            pixels.points[touch], pixels.normals[touch], pixels.handle[touch],
        )  # fmt: skip
    return None


def _stack(rows: list[tuple], n_points: int, n_contacts: int) -> ViewBank:
    columns = list(zip(*rows, strict=True)) or [()] * 11
    array = lambda k, dtype, *shape: np.array(columns[k], dtype).reshape(-1, *shape)  # noqa: E731
    return ViewBank(
        scene=array(0, np.int32),
        q=array(1, np.float32),
        opening=array(2, bool),
        azimuth=array(3, np.float32),
        elevation=array(4, np.float32),
        points=array(5, np.float16, n_points, 3),
        normals=array(6, np.float16, n_points, 3),
        part_mask=array(7, bool, n_points),
        contacts=array(8, np.float32, n_contacts, 3),
        contact_normals=array(9, np.float32, n_contacts, 3),
        contact_handle=array(10, bool, n_contacts),
    )
