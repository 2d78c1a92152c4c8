"""Pictures of converted objects, and the page that tells how faithful a conversion is. No OpenGL: rays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import trimesh
from matplotlib import image as image_file
from scipy.spatial import ConvexHull
from trimesh.ray.ray_pyembree import RayMeshIntersector

from conversion.partnet import ConvertedObject, PartNetObject

_LIGHT = np.array([-0.5, 0.35, 0.8]) / np.linalg.norm([-0.5, 0.35, 0.8])
_PALETTE = np.array(
    [[0.62, 0.72, 0.84], [0.86, 0.70, 0.55], [0.66, 0.80, 0.62], [0.82, 0.64, 0.72], [0.74, 0.70, 0.86]]
)
_BODY, _HANDLE = np.array([0.80, 0.78, 0.74]), np.array([0.25, 0.25, 0.28])


def picture(converted: ConvertedObject, size: int = 256) -> np.ndarray:
    """Visual and hulls closed, visual and hulls with doors and drawers open: [size, 4 * size, 3] uint8."""
    obj = converted.obj
    out = []
    frame = None
    for opening in (1.0, 0.0):  # the camera is placed for the open object, which needs more room
        values = {p.joint: p.closed + p.sign * p.width * opening for p in converted.parts}
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
    part = path.with_name(path.name + ".part")
    image_file.imsave(part, image, format="png")
    part.replace(path)


def render(
    triangles: np.ndarray,
    colors: np.ndarray,
    frame: tuple[np.ndarray, np.ndarray],
    size: int = 256,
    azimuth_deg: float = 35,
    elevation_deg: float = 25,
) -> np.ndarray:
    """Shaded picture [size, size, 3] uint8 of triangles [m, 3, 3] with colors [m, 3] in 0..1, seen from the front (-x).

    frame: corners of the box that must fit into the picture.
    """
    azimuth, elevation = np.deg2rad([azimuth_deg, elevation_deg])
    back = np.array([-np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([-np.sin(azimuth), -np.cos(azimuth), 0])
    up = np.cross(back, right)
    up, right = (up, right) if up[2] > 0 else (-up, right)
    centre, radius = (frame[0] + frame[1]) / 2, np.linalg.norm(frame[1] - frame[0]) / 2
    grid = (np.arange(size) + 0.5) / size * 2 - 1
    x, y = np.meshgrid(grid, -grid)
    origin = centre + radius * (2.5 * back + 1.0 * (x[..., None] * right + y[..., None] * up)).reshape(-1, 3)
    mesh = trimesh.Trimesh(triangles.reshape(-1, 3), np.arange(len(triangles) * 3).reshape(-1, 3), process=False)
    hit = RayMeshIntersector(mesh).intersects_first(origin, np.tile(-back, (len(origin), 1)))
    a, b, c = triangles.transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-30
    normal *= np.sign(normal @ back)[:, None]
    shade = 0.45 + 0.55 * np.clip(normal @ _LIGHT, 0, 1)
    image = np.ones((size * size, 3))
    image[hit >= 0] = (colors * shade[:, None])[hit[hit >= 0]]
    return (image.reshape(size, size, 3).clip(0, 1) * 255).astype(np.uint8)


def _visuals(obj: PartNetObject, values: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
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
    return _HANDLE if is_handle else _BODY if group == 0 else _PALETTE[(group - 1) % len(_PALETTE)]
