"""Does the generator spread like the real objects? Distributions of both as a figure and as numbers.

    vatmart generate --out MADE --count 200
    python experiments/conversion_generator.py --real REAL --made MADE

Difference between objects: 3,000 surface points of each in a grid of 20 cells per unit length, and for every object
the largest overlap (intersection over union of occupied cells) with any other of the same set.
"""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import trimesh
import tyro

from conversion.finger_clearance import check_finger_clearance
from conversion.model import ArticulatedObject, ObjectError
from conversion.part_detection import detect_parts
from conversion.readers import read_object

HERE = Path(__file__).parent
PAPER = ("StorageFurniture", "Refrigerator", "Microwave", "Door", "Safe", "Table", "WashingMachine")
Measured = dict[str, list[float]]


def measure(folder: Path) -> tuple[Measured, list[np.ndarray]]:
    """What the figure shows, of all objects of the paper's categories with a door or drawer; their occupied cells."""
    out: Measured = {}
    cells = []

    def add(key: str, value: float) -> None:
        out.setdefault(key, []).append(float(value))

    for path in sorted(p for p in folder.iterdir() if (p / "mobility.urdf").is_file()):
        try:
            obj = read_object(path)
        except ObjectError:
            continue
        found, left_out = detect_parts(obj)
        if obj.category not in PAPER or not found:
            continue
        add("doors and drawers per object", len(found))
        add("other moving links per object", len(left_out))
        add("leaves per object", sum(len(link.visuals) for link in obj.links.values()))
        cells.append(_cells(obj))
        for part in found:
            visuals = obj.group_visuals(part.link)
            extent = np.sort(np.ptp(np.concatenate([v.vertices for v in visuals]), axis=0))
            add("longest side of a part", extent[2])
            add("middle side of a part", extent[1])
            add("thinnest side of a part", extent[0])
            add("range of doors, degrees" if part.kind == "door" else "range of drawers, unit lengths",
                np.rad2deg(part.joint_range) if part.kind == "door" else part.joint_range)  # fmt: skip
            own = [v for v in visuals if v.is_handle]
            if part.kind == "door" and len(own) < len(visuals):
                add("thickness of a door", _thickness(np.concatenate(
                    [v.vertices[v.faces].reshape(-1, 3) for v in visuals if not v.is_handle])))  # fmt: skip
            fingers = any(h.clear_in_mesh for h in check_finger_clearance(obj, part, []))
            add("handle: none, knob or lip, bar", 0 if not own else 2 if fingers else 1)
            if own:
                size = np.sort(np.ptp(np.concatenate([v.vertices for v in own]), axis=0))
                add("length of a part's handles", size[2])
    return out, cells


def _thickness(corners: np.ndarray) -> float:
    """Median over rays through triangles [3 n, 3] along their thinnest extent, from the first to the last hit."""
    low, high = corners.min(axis=0), corners.max(axis=0)
    across = int(np.argmin(high - low))
    starts = np.random.default_rng(0).uniform(low, high, (200, 3))
    starts[:, across] = low[across] - 0.1
    mesh = trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)
    ways = np.tile(np.eye(3)[across], (len(starts), 1))
    hits, rays, _ = mesh.ray.intersects_location(starts, ways, multiple_hits=True)
    return float(np.median([np.ptp(hits[rays == ray, across]) for ray in np.unique(rays)]))


def _cells(obj: ArticulatedObject) -> np.ndarray:
    """[n, 3] int, distinct, of a centred object at joint values 0."""
    poses = obj.link_poses()
    corners = np.concatenate([
        (v.vertices @ poses[k][:3, :3].T + poses[k][:3, 3])[v.faces] for k, x in obj.links.items() for v in x.visuals
    ]).reshape(-1, 3)  # fmt: skip
    mesh = trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)
    points = trimesh.sample.sample_surface(mesh, 3000, seed=0)[0]
    points -= (corners.min(axis=0) + corners.max(axis=0)) / 2
    return np.unique(np.floor(points * 20).astype(int), axis=0)


def nearest_overlap(cells: list[np.ndarray]) -> list[float]:
    sets = [set(map(tuple, c.tolist())) for c in cells]
    return [max(len(a & b) / len(a | b) for b in sets if b is not a) for a in sets]


def main(
    real: Path,
    made: Path,
    figure: Path = HERE / "results/generator.png",
    results: Path = HERE / "results/generator.json",
) -> None:
    (a, cells_a), (b, cells_b) = measure(real), measure(made)
    a["overlap with the most similar object"] = nearest_overlap(cells_a)
    b["overlap with the most similar object"] = nearest_overlap(cells_b)
    table: dict[str, dict] = {}
    for key in a:
        for name, x in (("real", a), ("generated", b)):
            p10, p50, p90 = np.percentile(x[key], [10, 50, 90]).round(3).tolist()
            table.setdefault(key, {})[name] = {"n": len(x[key]), "p10": p10, "p50": p50, "p90": p90}
    kinds = "handle: none, knob or lip, bar"
    for name, x in (("real", a), ("generated", b)):
        table[kinds][name] = np.bincount(np.array(x[kinds], int), minlength=3).tolist()
    table["objects"] = {"real": len(cells_a), "generated": len(cells_b)}
    results.write_text(json.dumps(table, indent=1) + "\n")
    print(json.dumps(table, indent=1))
    fig, axes = plt.subplots(3, 4, figsize=(15, 9))
    for ax, key in zip(axes.flat, a, strict=False):
        both = np.concatenate([a[key], b[key]])
        high = np.percentile(both, 99)
        whole = (both == both.round()).all()
        bins = np.arange(-0.5, min(high, 40) + 1.5) if whole and high < 40 else np.linspace(both.min(), high, 25)
        for x, color, name in ((a, "#4c72b0", "real"), (b, "#dd8452", "generated")):
            ax.hist(np.clip(x[key], bins[0], bins[-1]), bins, density=True, alpha=0.55, color=color, label=name)
        ax.set_title(key, fontsize=10)
        ax.set_yticks([])
        if key == kinds:
            ax.set_xticks([0, 1, 2], ["none", "knob or lip", "bar"])
    axes.flat[0].legend()
    for ax in list(axes.flat)[len(a) :]:
        ax.axis("off")
    fig.tight_layout()
    fig.savefig(figure, dpi=80)


if __name__ == "__main__":
    tyro.cli(main)
