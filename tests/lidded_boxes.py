"""Boxes with hinged lids, made of boxes: the hinge at the back edge, the handle in front, on top, or none."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from conftest import BAR, THICK, Box, Cabinet, Part, _box, scene_bank

from vatmart_jax.data.banks import HINGE, SLIDE, SceneBank, ViewBank

THIN = 0.0075


@dataclass(frozen=True)
class LiddedBox(Cabinet):
    """Its lid stands for a cabinet's door; the drawer is a block inside."""

    handle: str = "none"

    def boards(self) -> list[Box]:
        d, w, h = self.size
        t = THICK / 2
        ends = [_box((x, 0, 0), (t, w / 2, h / 2)) for x in (-d / 2 + t, d / 2 - t)]
        sides = [_box((0, y, 0), (d / 2, t, h / 2)) for y in (-w / 2 + t, w / 2 - t)]
        return [_box((0, 0, -h / 2 + t), (d / 2, w / 2, t)), *ends, *sides]

    def door(self) -> Part:
        d, w, h = self.size
        slab = _box((0, 0, h / 2 + 0.002 + THICK / 2), (d / 2, w / 2, THICK / 2))
        return Part(HINGE, (slab, *self._handle(slab)), np.array([d / 2, 0, h / 2]), np.array([0, 1.0, 0]), 1.75)

    def drawer(self) -> Part:
        block = _box((0, 0, -self.size[2] / 4), (0.02, 0.02, 0.02))
        return Part(SLIDE, (block,), block.centre, np.array([-1.0, 0, 0]), 0.1)

    def _handle(self, slab: Box) -> list[Box]:
        """Two posts and a bar along y, which stand out of the lid's front or top."""
        if self.handle == "none":
            return []
        out = np.array([-1.0, 0, 0]) if self.handle == "front" else np.array([0, 0, 1.0])
        foot = slab.centre + slab.half * out + [0.0 if self.handle == "front" else -self.size[0] / 2 + 0.08, 0, 0]
        across, long = np.full(3, THIN), np.array([0, 0.05, 0])
        posts = [_box(foot + BAR / 2 * out + s * long, across + (BAR / 2 - THIN) * np.abs(out), True) for s in (-1, 1)]
        return [*posts, _box(foot + (BAR - THIN) * out, across + long, True)]

    def contacts(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """16 points of the closed lid, their normals, and which lie on the handle: half of them on the lid's top, half
        on the bar's outer side or, without a handle, on the lid's front edge."""
        slab, *handle = self.door().boxes
        held = handle[-1] if handle else slab
        out = np.array([0, 0, 1.0]) if self.handle == "top" else np.array([-1.0, 0, 0])
        points, normals = [], []
        for box, normal, margin in ((slab, np.array([0, 0, 1.0]), 0.06), (held, out, 0.02)):
            free = np.maximum(box.half - margin, 0) * (1 - np.abs(normal))
            points.append(box.centre + rng.uniform(-1, 1, (8, 3)) * free + box.half * normal)
            normals.append(np.tile(normal, (8, 1)))
        return np.concatenate(points), np.concatenate(normals), (np.arange(16) >= 8) & bool(handle)


def lidded_boxes(views: int = 3) -> tuple[SceneBank, ViewBank]:
    """Three Scenes, one per kind of handle, and `views` views of each for either direction."""
    sizes = {"front": (0.4, 0.6, 0.4), "top": (0.5, 0.5, 0.5), "none": (0.6, 0.8, 0.3)}
    objects = [
        LiddedBox(name, "Box", "train", size, 1, 0, (0.0, 0.0, 0.3 * i), views, name)
        for i, (name, size) in enumerate(sizes.items())
    ]
    bank = scene_bank(objects)
    bank = replace(bank, part_kind=np.where(bank.joint_type == HINGE, "lid", "drawer"))
    rng, rows = np.random.default_rng(0), []
    for scene, box in enumerate(objects):
        lid = box.door()
        for direction in (-1, 1):
            for k in range(views):
                q = lid.width * ((0.1 if direction > 0 else 0.6) + 0.1 * k)
                points, normals, on_handle = box.contacts(rng)
                rows.append(
                    {
                        "scene": scene, "joint_pos": np.float32(q), "direction": np.int8(direction),
                        "azimuth": np.float32(0), "elevation": np.float32(0.8),
                        "points": np.zeros((8, 3), np.float16), "part_mask": np.ones(8, bool),
                        "contacts": lid.moved(points, q).astype(np.float32),
                        "contact_normals": lid.turned(normals, q).astype(np.float32), "contact_handle": on_handle,
                    }
                )  # fmt: skip
    columns = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    columns["scene"] = columns["scene"].astype(np.int32)
    return bank.select(np.flatnonzero(bank.joint_type == HINGE)), ViewBank(**columns)
