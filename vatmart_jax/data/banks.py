"""SceneBank and ViewBank: what training knows of the objects, as plain arrays in .npz files.

Both files are written by `conversion` and read here; nothing else passes between the two packages. They hold
geometry and labels only. Physics constants (gains, masses, friction) belong to `vatmart_jax.physics`, so that
changing them needs no new conversion.

Frames: the object frame is the world frame, z up, the object's front towards -x, unit lengths as in the dataset.
A part's joint position q >= 0 is in radians (hinge) or unit lengths (slide) away from closed, whatever sign and offset
the URDF's joint uses.

Files carry a format number; those of earlier formats are migrated while they are loaded (`_MIGRATIONS`).
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vatmart_jax.atomic_io import atomic_write
from vatmart_jax.camera import Camera
from vatmart_jax.data.part_kinds import HINGE as HINGE
from vatmart_jax.data.part_kinds import SLIDE as SLIDE
from vatmart_jax.errors import UserError

FORMAT = 2


class BankError(UserError):
    """A bank file is missing, truncated or not what it should be."""


@dataclass(frozen=True, kw_only=True)
class SceneBank:
    """S Scenes, each one moving part of one object with everything else static (host arrays).

    Collision geometry is a table of G shapes, shared by all Scenes, and I instances that place shapes in a Scene.
    Shapes are convex hulls (`collision == "hull"`: vertices `hull_start[g]:hull_start[g+1]` of `hull_vertices`) or
    oriented boxes (`collision == "box"`: half extents in `box_size`, the pose is the instance's).
    """

    collision: str  # "hull" or "box"
    hull_vertices: np.ndarray  # [V, 3] float32, in the frame of the link they belong to; V = 0 in a box bank
    hull_start: np.ndarray  # [G + 1] int32; [1] in a box bank
    box_size: np.ndarray  # [G, 3] float32 half extents; G = 0 in a hull bank
    instance_shape: np.ndarray  # [I] int32, index into the shapes
    instance_pos: np.ndarray  # [I, 3] float64, in the object frame (static) or the part's frame (part)
    instance_quat: np.ndarray  # [I, 4] float64 wxyz, likewise
    instance_handle: np.ndarray  # [I] bool, the shape belongs to a handle, knob or pull
    static_start: np.ndarray  # [S + 1] int32: Scene s has static instances static_start[s]:static_start[s+1]
    part_start: np.ndarray  # [S + 1] int32: and part instances part_start[s]:part_start[s+1]
    object_id: np.ndarray  # [S] str
    category: np.ndarray  # [S] str, PartNet-Mobility's model_cat
    split: np.ndarray  # [S] str: train, test_shapes, test_categories or extra
    part: np.ndarray  # [S] str, URDF name of the moving link
    joint: np.ndarray  # [S] str, URDF name of its joint
    variant: np.ndarray  # [S] int32, 0 = other parts closed; further ones have them at sampled values
    part_kind: np.ndarray  # [S] str, name of a PartKind: door, drawer, lid
    joint_type: np.ndarray  # [S] int32, HINGE or SLIDE
    part_pos: np.ndarray  # [S, 3] float64, part frame when closed, object frame; its origin lies on the joint's axis
    part_quat: np.ndarray  # [S, 4] float64 wxyz
    axis: np.ndarray  # [S, 3] float64 unit, part frame; positive motion opens
    joint_range: np.ndarray  # [S] float64, joint positions are in [0, joint_range]
    urdf_closed: np.ndarray  # [S] float64, URDF joint value = urdf_closed + urdf_sign * q
    urdf_sign: np.ndarray  # [S] float64, +1 or -1

    def __len__(self) -> int:
        return len(self.object_id)

    @property
    def n_shapes(self) -> int:
        return len(self.box_size) if self.collision == "box" else len(self.hull_start) - 1

    def hull(self, shape: int) -> np.ndarray:
        """Vertices [n, 3] of one hull."""
        return self.hull_vertices[self.hull_start[shape] : self.hull_start[shape + 1]]

    def select(self, scenes: np.ndarray) -> SceneBank:
        """The bank of only these Scenes (indices or boolean mask), with only the shapes that they use."""
        scenes = np.arange(len(self))[scenes]
        out = {f.name: getattr(self, f.name) for f in fields(self)}
        for name in _PER_SCENE:
            out[name] = out[name][scenes]
        instances = []
        # Instances of a Scene are stored statics first, all Scenes' statics and parts sharing one table.
        for name in ("static_start", "part_start"):
            start = getattr(self, name)
            rows = [np.arange(start[s], start[s + 1]) for s in scenes]
            base = sum(len(r) for r in instances)
            out[name] = (base + np.cumsum([0] + [len(r) for r in rows])).astype(np.int32)
            instances.extend(rows)
        rows = np.concatenate(instances) if instances else np.zeros(0, int)
        for name in _PER_INSTANCE:
            out[name] = out[name][rows]
        used, out["instance_shape"] = np.unique(out["instance_shape"], return_inverse=True)
        out["instance_shape"] = out["instance_shape"].astype(np.int32)
        if self.collision == "box":
            out["box_size"] = self.box_size[used]
        else:
            hulls = [self.hull(g) for g in used]
            out["hull_vertices"] = np.concatenate(hulls) if hulls else np.zeros((0, 3), np.float32)
            out["hull_start"] = np.cumsum([0] + [len(h) for h in hulls]).astype(np.int32)
        return SceneBank(**out)

    @classmethod
    def concatenate(cls, banks: Sequence[SceneBank]) -> SceneBank:
        """One bank of the Scenes of several, in their order. Raises ValueError where collision geometry differs."""
        if len(kinds := {bank.collision for bank in banks}) > 1:
            raise ValueError(f"their collision geometry differs ({', '.join(sorted(kinds))})")
        out: dict[str, Any] = {
            name: np.concatenate([getattr(bank, name) for bank in banks])
            for name in (*_PER_SCENE, *_PER_INSTANCE, "hull_vertices", "box_size")
        }
        out["hull_start"] = _starts(bank.hull_start for bank in banks)
        statics, parts = (_starts(getattr(bank, name) for bank in banks) for name in ("static_start", "part_start"))
        out["static_start"], out["part_start"] = statics, statics[-1] + parts
        # Statics come before parts: those of all banks, as in each of them.
        is_part = np.concatenate([np.arange(len(bank.instance_shape)) >= bank.static_start[-1] for bank in banks])
        order = np.argsort(is_part, kind="stable")
        out |= {name: out[name][order] for name in _PER_INSTANCE}
        shapes = np.cumsum([0] + [bank.n_shapes for bank in banks[:-1]])
        first = np.repeat(shapes, [len(bank.instance_shape) for bank in banks])[order]
        out["instance_shape"] = (out["instance_shape"] + first).astype(np.int32)
        return cls(collision=banks[0].collision, **out)

    def save(self, path: Path | str) -> None:
        """Write one .npz file, complete or not at all."""
        _save(path, "scenes", {f.name: getattr(self, f.name) for f in fields(self)})

    @classmethod
    def load(cls, path: Path | str) -> SceneBank:
        """Raises BankError where the file is missing, truncated or of another kind."""
        arrays = _load(path, "scenes", [f.name for f in fields(cls)])
        arrays["collision"] = str(arrays["collision"])
        return cls(**arrays)


_PER_SCENE = (
    "object_id", "category", "split", "part", "joint", "variant", "part_kind", "joint_type",
    "part_pos", "part_quat", "axis", "joint_range", "urdf_closed", "urdf_sign",
)  # fmt: skip
_PER_INSTANCE = ("instance_shape", "instance_pos", "instance_quat", "instance_handle")


@dataclass(frozen=True, kw_only=True)
class ViewBank:
    """V partial point clouds of Scenes at one start value each (host arrays).

    Points are in random order, so the first n of them are a uniform sample of the view. `contacts` are further
    pixels of the moving part alone, also in random order, drawn from the full-resolution image: where a trial may
    touch. Drawers can be a few pixels of a whole cabinet, so they are kept apart from the cloud.
    """

    scene: np.ndarray  # [V] int32
    joint_pos: np.ndarray  # [V] float32, of the part in the picture
    direction: np.ndarray  # [V] int8, +1 drawn for tasks that open (range left to open), -1 for those that close
    azimuth: np.ndarray  # [V] float32 rad, camera direction about z, 0 = in front (-x)
    elevation: np.ndarray  # [V] float32 rad
    points: np.ndarray  # [V, N, 3] float16, object frame
    part_mask: np.ndarray  # [V, N] bool, the point lies on the moving part
    contacts: np.ndarray  # [V, C, 3] float32, object frame
    contact_normals: np.ndarray  # [V, C, 3] float32 unit, towards the camera
    contact_handle: np.ndarray  # [V, C] bool, the contact lies on a handle, knob or pull

    def __len__(self) -> int:
        return len(self.scene)

    def camera(self, view: int, centre: np.ndarray | None = None) -> Camera:
        """The camera that took a view, looking at `centre` [3] (default the origin) from one unit length away."""
        at = np.zeros(3) if centre is None else centre
        return Camera.looking_at(at, float(self.azimuth[view]), float(self.elevation[view]))

    def select(self, views: np.ndarray) -> ViewBank:
        """The bank of only these views (indices or boolean mask)."""
        return ViewBank(**{f.name: getattr(self, f.name)[views] for f in fields(self)})

    def of_scenes(self, scenes: np.ndarray) -> ViewBank:
        """The views of these Scenes, renumbered to match `SceneBank.select(scenes)`. scenes: [n] int."""
        new = np.full(max(int(self.scene.max(initial=-1)), int(np.max(scenes, initial=-1))) + 1, -1, np.int32)
        new[scenes] = np.arange(len(scenes))
        kept = self.select(new[self.scene] >= 0)
        return ViewBank(**{**{f.name: getattr(kept, f.name) for f in fields(kept)}, "scene": new[kept.scene]})

    @classmethod
    def concatenate(cls, banks: Sequence[ViewBank], scenes: Sequence[int]) -> ViewBank:
        """One bank of the views of several, whose Scenes number `scenes`, to match `SceneBank.concatenate`.

        Raises ValueError where the views have different numbers of points or contacts.
        """
        if len(sizes := {(bank.points.shape[1], bank.contacts.shape[1]) for bank in banks}) > 1:
            raise ValueError(f"their views differ in points and contacts {sorted(sizes)}")
        out = {f.name: np.concatenate([getattr(bank, f.name) for bank in banks]) for f in fields(cls)}
        out["scene"] = out["scene"] + np.repeat(np.cumsum([0, *scenes[:-1]]), [len(b) for b in banks]).astype(np.int32)
        return cls(**out)

    def save(self, path: Path | str) -> None:
        """Write one .npz file, complete or not at all."""
        _save(path, "views", {f.name: getattr(self, f.name) for f in fields(self)})

    @classmethod
    def load(cls, path: Path | str) -> ViewBank:
        """Raises BankError where the file is missing, truncated or of another kind."""
        return cls(**_load(path, "views", [f.name for f in fields(cls)]))


class SceneTable(struct.PyTreeNode, kw_only=True):
    """What the environment needs of S Scenes, on device."""

    anchor: jax.Array  # [S, 3] a point on the joint's axis, object frame
    axis: jax.Array  # [S, 3] unit, object frame, positive motion opens
    joint_range: jax.Array  # [S]

    @classmethod
    def from_bank(cls, bank: SceneBank) -> SceneTable:
        w, v = bank.part_quat[:, :1], bank.part_quat[:, 1:]
        t = 2 * np.cross(v, bank.axis)
        axis = bank.axis + w * t + np.cross(v, t)
        return cls(
            anchor=jnp.asarray(bank.part_pos, jnp.float32),
            axis=jnp.asarray(axis, jnp.float32),
            joint_range=jnp.asarray(bank.joint_range, jnp.float32),
        )


def _scenes_of_format_1(arrays: dict[str, Any]) -> None:
    """Every hinge was a door."""
    arrays["part_kind"] = np.where(arrays["joint_type"] == SLIDE, "drawer", "door")
    arrays["joint_range"] = arrays.pop("width")


def _views_of_format_1(arrays: dict[str, Any]) -> None:
    """Views had the normals of all points too, which nothing read and `_load` leaves alone."""
    arrays["joint_pos"] = arrays.pop("q")
    arrays["direction"] = np.where(arrays.pop("opening"), 1, -1).astype(np.int8)


_MIGRATIONS: dict[tuple[str, int], Callable[[dict[str, Any]], None]] = {  # from this format to the next, in place
    ("scenes", 1): _scenes_of_format_1,
    ("views", 1): _views_of_format_1,
}


def _starts(starts: Iterable[np.ndarray]) -> np.ndarray:
    """Where the rows of several tables begin when they follow each other, from where they begin in each of them."""
    return np.concatenate([[0], *(np.diff(start) for start in starts)]).cumsum().astype(np.int32)


def _save(path: Path | str, kind: str, arrays: dict[str, np.ndarray | str]) -> None:
    with atomic_write(path) as part, part.open("wb") as f:
        np.savez(f, **{"format": np.int32(FORMAT), "kind": np.array(kind), **arrays})  # pyright: ignore[reportArgumentType]


def _load(path: Path | str, kind: str, names: list[str]) -> dict:
    if not Path(path).is_file():
        raise BankError(f"{path}: no such file; make it with `vatmart convert`")
    try:
        with np.load(path, allow_pickle=False) as f:
            found = int(f["format"])
            if str(f["kind"]) != kind or not 1 <= found <= FORMAT:
                raise BankError(f"{path}: not a {kind} bank of format {FORMAT}; make it again with `vatmart convert`")
            arrays = {name: f[name] for name in f.files if name not in ("format", "kind", "normals")}
        for number in range(found, FORMAT):
            _MIGRATIONS[kind, number](arrays)
        return {name: arrays[name] for name in names}
    except (OSError, EOFError, KeyError, TypeError, ValueError, zipfile.BadZipFile) as e:  # TypeError: a .npy file
        if isinstance(e, BankError):
            raise
        raise BankError(f"{path}: damaged ({e}); make it again with `vatmart convert`") from e
