"""Pictures of converted objects. No OpenGL: rays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib import image as image_file
from scipy.spatial import ConvexHull

from conversion.model import ArticulatedObject, ConvertedObject
from conversion.palette import BODY, HANDLE, PARTS
from conversion.raycast import first_triangle
from vatmart_jax.atomic_io import atomic_write
from vatmart_jax.camera import Camera

AZIMUTH, ELEVATION = np.deg2rad(-35), np.deg2rad(25)  # from the front right
_LIGHT = np.array([-0.5, 0.35, 0.8]) / np.linalg.norm([-0.5, 0.35, 0.8])
_BODY, _HANDLE, _PARTS = np.array(BODY), np.array(HANDLE), np.array(PARTS)


def render_preview(converted: ConvertedObject, size: int = 256) -> np.ndarray:
    """Visual and hulls closed, visual and hulls with all parts open: [size, 4 * size, 3] uint8."""
    obj = converted.obj
    out = []
    frame = None
    for share in (1.0, 0.0):  # the camera is placed for the open object, which needs more room
        values = {p.joint: p.closed + p.sign * p.joint_range * share for p in converted.parts}
        for triangles, colors in (_visuals(obj, values), _hulls(converted, values)):
            if frame is None:
                corners = triangles.reshape(-1, 3)
                frame = corners.min(axis=0), corners.max(axis=0)
            out.append(render(triangles, colors, frame, size))
    return np.concatenate(out[2:] + out[:2], axis=1)


def contact_sheet(pictures: Sequence[np.ndarray], columns: int) -> np.ndarray:
    """Pictures of one size as a grid [rows * h, columns * w, 3] uint8."""
    h, w, _ = pictures[0].shape
    rows = -(-len(pictures) // columns)
    sheet = np.full((rows * h, columns * w, 3), 255, np.uint8)
    for i, p in enumerate(pictures):
        r, c = divmod(i, columns)
        sheet[r * h : (r + 1) * h, c * w : (c + 1) * w] = p
    return sheet


def save_png(path: Path, image: np.ndarray) -> None:
    """Complete or not at all."""
    with atomic_write(path) as part:
        image_file.imsave(part, image, format="png")


def read_png(path: Path) -> np.ndarray:
    """[h, w, 3] uint8."""
    return (image_file.imread(path)[..., :3] * 255).round().astype(np.uint8)


def render(
    triangles: np.ndarray, colors: np.ndarray, frame: tuple[np.ndarray, np.ndarray], size: int = 256
) -> np.ndarray:
    """Shaded picture [size, size, 3] uint8 of triangles [m, 3, 3] with colors [m, 3] in 0..1, seen from the front (-x).

    frame: corners of the box that must fit into the picture.
    """
    centre, radius = (frame[0] + frame[1]) / 2, float(np.linalg.norm(frame[1] - frame[0])) / 2
    camera = Camera.looking_at(centre, AZIMUTH, ELEVATION, 2.5 * radius)
    grid = (np.arange(size) + 0.5) / size * 2 - 1
    x, y = np.meshgrid(grid, -grid)
    origin = camera.position + radius * (x[..., None] * camera.right + y[..., None] * camera.up).reshape(-1, 3)
    hit = first_triangle(triangles, origin, camera.forward)
    a, b, c = triangles.transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-30
    normal *= -np.sign(normal @ camera.forward)[:, None]
    shade = 0.45 + 0.55 * np.clip(normal @ _LIGHT, 0, 1)
    image = np.ones((size * size, 3))
    image[hit >= 0] = (colors * shade[:, None])[hit[hit >= 0]]
    return (image.reshape(size, size, 3).clip(0, 1) * 255).astype(np.uint8)


def _visuals(obj: ArticulatedObject, values: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
    poses, moving = obj.link_poses(values), list(obj.groups)
    triangles, colors = [], []
    for link in obj.links.values():
        group = moving.index(obj.group_root(link.name))
        for v in link.visuals:
            points = v.vertices @ poses[link.name][:3, :3].T + poses[link.name][:3, 3]
            triangles.append(points[v.faces])
            colors.append(np.tile(_color(group, v.is_handle), (len(v.faces), 1)))
    return np.concatenate(triangles), np.concatenate(colors)


def _hulls(converted: ConvertedObject, values: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
    poses = converted.obj.link_poses(values)
    triangles, colors = [np.zeros((0, 3, 3))], [np.zeros((0, 3))]
    for group, (root, hulls) in enumerate(converted.hulls.items()):
        for i, h in enumerate(hulls):
            points = h.vertices @ poses[root][:3, :3].T + poses[root][:3, 3]
            simplices = ConvexHull(points).simplices
            triangles.append(points[simplices])
            # Neighbouring hulls differ in brightness, or a stack of boards would look like one block.
            colors.append(np.tile(_color(group, h.is_handle) * (1 - 0.06 * (i % 4)), (len(simplices), 1)))
    return np.concatenate(triangles), np.concatenate(colors)


def _color(group: int, is_handle: bool) -> np.ndarray:
    return _HANDLE if is_handle else _BODY if group == 0 else _PARTS[(group - 1) % len(_PARTS)]
