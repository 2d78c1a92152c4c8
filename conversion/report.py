"""Pictures of converted objects, and the page that tells how faithful a conversion is. No OpenGL: rays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import trimesh
from matplotlib import image as image_file
from scipy.spatial import ConvexHull
from trimesh.ray.ray_pyembree import RayMeshIntersector

from conversion.partnet import ConvertedObject, PartNetObject
from vatmart_jax.atomic_io import whole

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
    with whole(path) as part:
        image_file.imsave(part, image, format="png")


def read_png(path: Path) -> np.ndarray:
    """[h, w, 3] uint8."""
    return (image_file.imread(path)[..., :3] * 255).round().astype(np.uint8)


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


_PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><title>Conversion report</title>
<style>
body {{ font: 14px system-ui, sans-serif; margin: 2em; color: #222 }}
table {{ border-collapse: collapse }}
th, td {{ padding: 4px 10px; border-bottom: 1px solid #ddd; text-align: left; vertical-align: top }}
th {{ cursor: pointer; position: sticky; top: 0; background: #f4f4f4 }}
td.n {{ text-align: right; font-variant-numeric: tabular-nums }}
td.bad {{ background: #fbe3dd }}
img {{ width: 520px; display: block }}
td:last-child {{ max-width: 26em }}
td:last-child small {{ display: block; max-height: 9em; overflow: auto }}
small {{ color: #666 }}
</style>
<h1>Conversion report</h1>
<p>{summary}</p>
<p><small>Pictures: visual meshes and hulls closed, then open. Gap: visual surface outside the hulls. Phantom: share of
hull surface farther than 0.02 from any visual surface. Handles: those a finger still passes behind, of those it passes
behind in the visual meshes. Lengths in unit lengths of the object. Click a heading to sort.</small></p>
{refused}
<table id="objects"><thead><tr>{head}</tr></thead><tbody>
{rows}
</tbody></table>
<script>
document.querySelectorAll("#objects th").forEach((th, column) => th.onclick = () => {{
  const body = document.querySelector("#objects tbody"), down = th.dataset.down = th.dataset.down === "1" ? "0" : "1";
  const value = row => {{
    const text = row.cells[column].dataset.v ?? row.cells[column].innerText;
    return text !== "" && !isNaN(text) ? Number(text) : text;
  }};
  const compare = (a, b) => typeof a === typeof b ? (a < b ? -1 : a > b ? 1 : 0) : typeof a === "number" ? -1 : 1;
  [...body.rows].sort((a, b) => compare(value(a), value(b)) * (down === "1" ? -1 : 1)).forEach(r => body.append(r));
}});
</script>
</html>
"""


def page(
    reports: Sequence[Mapping[str, Any]], failed: Sequence[Mapping[str, str]], without_views: Sequence[str]
) -> str:
    """report.html of a data set, to lie beside the object folders; worst objects first.

    reports: the report.json of each object.
    """
    head = ("picture", "id", "category", "split", "parts", "hulls", "gap", "phantom", "handles", "seconds", "notes")
    rows = []
    for r in sorted(reports, key=_badness, reverse=True):
        groups = r["groups"].values()
        gap = max((g["gap_max"] for g in groups), default=0.0)
        phantom = max((g["phantom_share"] for g in groups), default=0.0)
        passable = [h for h in r["handles"] if h["visual"]]
        kept = sum(h["hulls"] for h in passable)
        notes = [*r["notes"], *(f"{x['joint']}: {x['reason']}" for x in r["left_out"])]
        notes += [f"{g}: {m['hulls']} hulls in a budget of {m['budget']}" for g, m in r["groups"].items() if _over(m)]
        parts = ", ".join(f"{p['link']} ({p['kind']})" for p in r["parts"])
        cells = [
            f'<td><img loading="lazy" src="{quote(r["id"])}/picture.png"></td>',
            f"<td>{escape(r['id'])}</td><td>{escape(r['category'])}</td><td>{escape(r['split'])}</td>",
            f'<td data-v="{len(r["parts"])}">{escape(parts)}</td>',
            f'<td class="n">{sum(g["hulls"] for g in groups)}</td>',
            f'<td class="n{" bad" * (gap > 0.005)}">{gap:.4f}</td>',
            f'<td class="n{" bad" * (phantom > 0.02)}">{phantom:.3f}</td>',
            f'<td class="n{" bad" * (kept < len(passable))}">{kept} / {len(passable)}</td>',
            f'<td class="n">{r["seconds"]:.1f}</td><td><small>{"<br>".join(map(escape, notes))}</small></td>',
        ]
        rows.append(f"<tr>{''.join(cells)}</tr>")
    listed = [f"<li><b>{escape(f['id'])}</b> refused: {escape(f['reason'])}</li>" for f in failed]
    listed += [f"<li>no views: {escape(why)}</li>" for why in without_views]
    return _PAGE.format(
        summary=escape(_summary(reports, failed)),
        refused=f"<ul>{''.join(listed)}</ul>" if listed else "",
        head="".join(f"<th>{h}</th>" for h in head),
        rows="\n".join(rows),
    )


def _over(group: Mapping[str, Any]) -> bool:
    return group["hulls"] > group["budget"]


def _badness(report: Mapping[str, Any]) -> float:
    """How far the worst group is beyond a gap of 0.005 or a phantom share of 0.02, in those units."""
    groups = report["groups"].values()
    lost = sum(h["visual"] and not h["hulls"] for h in report["handles"])
    return lost + max((max(g["gap_max"] / 0.005, g["phantom_share"] / 0.02) for g in groups), default=0.0)


def _summary(reports: Sequence[Mapping[str, Any]], failed: Sequence[Mapping[str, str]]) -> str:
    moving = [r["groups"][p["link"]] for r in reports for p in r["parts"]]
    seconds = np.array([r["seconds"] for r in reports] or [0.0])
    doors = sum(p["kind"] == "door" for r in reports for p in r["parts"])
    text = f"{len(reports)} objects converted, {len(failed)} refused; {doors} doors, {len(moving) - doors} drawers. "
    text += f"Seconds per object: median {np.median(seconds):.1f}, 90% {np.percentile(seconds, 90):.1f}, "
    text += f"most {seconds.max():.1f}. "
    if moving:
        gap = np.percentile([g["gap_max"] for g in moving], 90)
        share = np.percentile([g["phantom_share"] for g in moving], 90)
        text += f"Doors and drawers, 90%: gap within {gap:.4f}, phantom surface within {share:.2%}. "
    passable = [h for r in reports for h in r["handles"] if h["visual"]]
    if passable:
        kept = sum(h["hulls"] for h in passable)
        text += f"A finger still passes behind {kept} of {len(passable)} handles."
    return text
