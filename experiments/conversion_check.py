"""What `vatmart convert` promises, measured: one command per promise, results merged into one JSON file.

    python experiments/conversion_check.py all --src REAL --out DATA          # after `vatmart convert REAL --out DATA`
    python experiments/conversion_check.py kinematics steps --src REAL --out DATA

Oracles are independent of the converter where there are any: yourdfpy for poses, MuJoCo's rays for views, reachability
by sight (not by the converter's flood fill) for phantom surface. `speed` and `fuzz` convert into temporary folders.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import mujoco
import numpy as np
import trimesh
import tyro
import yourdfpy
from scipy.spatial import ConvexHull
from trimesh.ray.ray_pyembree import RayMeshIntersector

from conversion.config import ConvertConfig, ViewConfig
from conversion.convert import convert
from conversion.mjcf import VISUAL_GROUP
from conversion.model import ConvertedObject, Visual
from conversion.readers.partnet_mobility import URDF_NAMES
from conversion.render_views import DISTANCE, render_views
from conversion.scenes import scene_specs
from vatmart_jax.camera import Camera
from vatmart_jax.data.banks import SceneBank

RESULTS = Path(__file__).parent / "results" / "conversion.json"

Group = tuple[str, str, dict[str, Any]]  # object, link, gap_max and phantom_share of its hulls


@dataclass(frozen=True)
class Check:
    src: Path
    """Folder of PartNet-Mobility objects."""
    out: Path
    """What `vatmart convert` made of it."""
    results: Path = RESULTS
    """JSON file that the measured numbers are merged into."""
    only: tuple[str, ...] = ()
    """Ids of objects to look at; all if empty."""
    seed: int = 0

    def reports(self) -> list[dict[str, Any]]:
        found = [json.loads(p.read_text()) for p in sorted(self.out.glob("*/report.json"))]
        return [r for r in found if not self.only or r["id"] in self.only]


def share(values, bound: float) -> float:
    values = np.asarray(values)
    return round(float((values <= bound).mean()), 4) if len(values) else 1.0


def tta_transforms(values) -> dict[str, float]:
    values = np.asarray(values, float)
    if not len(values):
        return {}
    p50, p90 = np.percentile(values, [50, 90])
    return {"median": _round(p50), "p90": _round(p90), "max": _round(values.max())}


def _round(value: float) -> float:
    return float(f"{value:.4g}")


def objects(check: Check) -> dict[str, Any]:
    """1: how many are converted, and why the others are not."""
    failed = json.loads((check.out / "convert.json").read_text())["failed"]
    crashed = [f["id"] for f in failed if _crash(f["reason"])]
    refused = {f["id"]: f["reason"] for f in failed}
    reports = check.reports()
    kinds = [p["kind"] for r in reports for p in r["parts"]]
    return {
        "objects": len(reports) + len(failed),
        "converted": len(reports),
        "crashed": crashed,
        "refused": refused,
        "doors": kinds.count("door"),
        "drawers": kinds.count("drawer"),
        "without_parts": [r["id"] for r in reports if not r["parts"]],
    }


def _crash(reason: str) -> bool:
    """An exception that nobody meant to raise, a dead process, or one stopped by the clock."""
    return bool(re.search(r"the process died|took longer than|\(\w+\.py:\d+\)$", reason))


def kinematics(check: Check, configurations: int = 100) -> dict[str, Any]:
    """2: poses of every link in MuJoCo and by yourdfpy, at random joint values.

    yourdfpy multiplies a slide's value by its axis as written; MuJoCo takes the axis as a direction.
    """
    rng = np.random.default_rng(check.seed)
    worst: dict[str, float] = {}
    links = 0
    for r in check.reports():
        model = mujoco.MjModel.from_xml_path(str(check.out / r["id"] / "model.xml"))
        data = mujoco.MjData(model)
        urdf = next(p for n in URDF_NAMES if (p := check.src / r["id"] / n).is_file())
        oracle = yourdfpy.URDF.load(str(urdf), load_meshes=False)
        for j in oracle.robot.joints:
            if j.type != "fixed" and j.axis is not None:
                j.axis = j.axis / np.linalg.norm(j.axis)
        names = {model.joint(i).name for i in range(model.njnt)}
        joints = [j for j in oracle.robot.joints if j.name in oracle.actuated_joint_names]
        links += len(oracle.robot.links)
        worst[r["id"]] = 0.0
        for _ in range(configurations):
            values = {}
            for j in joints:
                low, high = -4.0, 4.0
                if j.limit is not None and j.limit.lower is not None and j.limit.upper is not None:
                    low, high = sorted((j.limit.lower, j.limit.upper))
                if j.type == "continuous":
                    low, high = -4.0, 4.0
                values[j.name] = rng.uniform(low, high)
                if j.name in names:  # a joint with an empty range is fixed
                    data.qpos[model.joint(j.name).qposadr[0]] = values[j.name]
            oracle.update_cfg(values)
            mujoco.mj_kinematics(model, data)
            for link in oracle.robot.links:
                pose = oracle.get_transform(link.name)
                body = data.body("world_" if link.name == "world" else link.name)
                error = max(np.abs(body.xpos - pose[:3, 3]).max(), np.abs(body.xmat - pose[:3, :3].ravel()).max())
                worst[r["id"]] = max(worst[r["id"]], float(error))
    top = max(worst, key=lambda k: worst[k])
    return {
        "objects": len(worst),
        "links": links,
        "configurations": configurations,
        "max_error": _round(worst[top]),
        "worst": top,
        "within_1e-5": share(list(worst.values()), 1e-5),
    }


def fidelity(check: Check) -> dict[str, Any]:
    """3: gap, phantom surface and fingers behind handles, from the reports of the conversion."""
    moving, rest, handles = [], [], []
    for r in check.reports():
        parts = {p["link"] for p in r["parts"]}
        static = next(iter(r["groups"]), None)
        moving += [(r["id"], k, g) for k, g in r["groups"].items() if k in parts]
        rest += [(r["id"], k, g) for k, g in r["groups"].items() if k == static and k not in parts]
        handles += [(r["id"], h["link"], h["clear_in_hulls"]) for h in r["handles"] if h["clear_in_mesh"]]
    lost = [f"{i} {link}" for i, link, kept in handles if not kept]
    of_handles = {"passable": len(handles), "kept": sum(kept for *_, kept in handles), "lost": lost}
    return _gaps_and_phantoms(moving, rest) | {"handles": of_handles}


def _gaps_and_phantoms(moving: list[Group], rest: list[Group], phantoms: int = 5) -> dict[str, Any]:
    """Of doors and drawers, and of all that stands still; `phantoms` of the worst are named."""
    out: dict[str, Any] = {}
    for name, rows, bound in (("moving", moving, 0.02), ("static", rest, 0.05)):
        gap, phantom = [g["gap_max"] for *_, g in rows], [g["phantom_share"] for *_, g in rows]
        out[name] = {
            "groups": len(rows),
            "gap": tta_transforms(gap),
            "gap_within_0.005": share(gap, 0.005),
            "phantom_share": tta_transforms(phantom),
            f"phantom_within_{bound}": share(phantom, bound),
            "worst_gap": _worst(rows, "gap_max"),
            "worst_phantom": _worst(rows, "phantom_share", phantoms),
        }
    return out


def _worst(rows: list[Group], key: str, n: int = 5) -> dict[str, float]:
    return {f"{i} {k}": _round(g[key]) for i, k, g in sorted(rows, key=lambda r: -r[2][key])[:n] if g[key] > 0}


def sight(check: Check) -> dict[str, Any]:
    """3 again, by other means: what is reachable is what can be seen from afar; distances are exact.

    Of every door, drawer and static rest: 3,000 samples of the visual surface and 3,000 of the hulls' outer surface,
    each looked at from 96 directions.
    """
    moving, rest = [], []
    for r in check.reports():
        converted = ConvertedObject.load(check.out / r["id"])
        parts = {p.link for p in converted.parts}
        for root, hulls in converted.hulls.items():
            visuals = converted.obj.group_visuals(root)
            if hulls and visuals and (root in parts or root == converted.obj.root):
                found = _by_sight(visuals, [h.vertices for h in hulls], np.random.default_rng(check.seed))
                (moving if root in parts else rest).append((r["id"], root, found))
    return _gaps_and_phantoms(moving, rest, phantoms=12)


def _by_sight(visuals: list[Visual], hulls: list[np.ndarray], rng: np.random.Generator) -> dict[str, float]:
    mesh = _mesh([v.vertices[v.faces] for v in visuals])
    skin = _mesh([h[ConvexHull(h).simplices] for h in hulls])
    seed = int(rng.integers(2**31))
    seen = trimesh.sample.sample_surface(mesh, 3000, seed=seed)[0]
    seen = np.concatenate([seen, mesh.vertices[:: max(1, len(mesh.vertices) // 1000)]])
    seen = seen[_visible(mesh, seen, rng)]
    planes = [ConvexHull(h).equations for h in hulls]

    def depth(p: np.ndarray) -> np.ndarray:
        return np.min([(p @ e[:, :3].T + e[:, 3]).max(axis=1) for e in planes], axis=0)

    out = seen[depth(seen) > 1e-4]
    gap = trimesh.proximity.closest_point(skin, out)[1] if len(out) else np.zeros(1)
    on = trimesh.sample.sample_surface(skin, 3000, seed=seed)[0]
    on = on[depth(on) > -1e-6]  # not inside another hull
    far = trimesh.proximity.closest_point(mesh, on)[1] > 0.02
    far[far] = _visible(mesh, on[far], rng)
    return {"gap_max": float(gap.max()), "phantom_share": float(far.mean()) if len(far) else 0.0}


def _visible(mesh: trimesh.Trimesh, points: np.ndarray, rng: np.random.Generator, n: int = 96) -> np.ndarray:
    """Whether anything outside the object sees the point: [len(points)] bool."""
    ways = rng.normal(size=(n, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    rays = RayMeshIntersector(mesh)
    out = np.zeros(len(points), bool)
    for way in ways:
        rows = np.flatnonzero(~out)
        out[rows] = ~rays.intersects_any(points[rows] + 1e-4 * way, np.tile(way, (len(rows), 1)))
    return out


def budget(check: Check) -> dict[str, Any]:
    """4: shapes per Scene, vertices per hull."""
    bank = SceneBank.load(check.out / "scenes.npz")
    static, part = np.diff(bank.static_start), np.diff(bank.part_start)
    vertices = np.diff(bank.hull_start)
    within = (static <= 32) & (part <= 16)
    said = {(r["id"], n) for r in check.reports() for n in ("merged_scenes",) if r[n]}
    merged = [m for r in check.reports() for m in r["merged_scenes"]]
    over = sorted({f"{o} {p}" for o, p in zip(bank.object_id[~within], bank.part[~within], strict=True)})
    return {
        "scenes": len(bank),
        "shapes": len(vertices) if bank.collision == "hull" else len(bank.box_size),
        "within_16_and_32": round(float(within.mean()), 4),
        "static": tta_transforms(static),
        "part": tta_transforms(part),
        "vertices_max": int(vertices.max(initial=0)),
        "over": over,
        "sides_merged": len(merged),
        "objects_that_merged": len(said),
        "merged_gap": tta_transforms([m["gap_max"] for m in merged]),
        "merged_phantom_share": tta_transforms([m["phantom_share"] for m in merged]),
        "merged_phantom_within_0.05": share([m["phantom_share"] for m in merged], 0.05),
    }


def speed(check: Check, subset: int = 12) -> dict[str, Any]:
    """5: seconds of one core per object; two processes against one on every n-th object, and what the machine gives.

    The control is work in which nothing is shared: how much of a factor of 2 there is to have. Everything is timed
    twice, in the order one, two, two, one, for neighbours of a shared server come and go. Start-up and banks (one
    process) are timed by making the banks again.
    """
    seconds = {r["id"]: r["seconds"] for r in check.reports()}
    slow = sorted(seconds, key=lambda k: -seconds[k])[:5]
    values = np.array(list(seconds.values()))
    names = sorted((n for n in seconds if seconds[n] < 20), key=lambda k: seconds[k])
    names = names[:: max(1, len(names) // subset)][:subset]
    wall: dict[int, list[float]] = {1: [], 2: []}
    core: dict[int, list[float]] = {1: [], 2: []}
    control: dict[int, list[float]] = {1: [], 2: []}
    for jobs in (1, 2, 2, 1):
        with tempfile.TemporaryDirectory() as out:
            command = ("convert", *(check.src / n for n in names), "--out", out, "--views", "0", "--jobs", str(jobs))
            wall[jobs].append(_vatmart(*command))
            core[jobs].append(sum(json.loads(p.read_text())["seconds"] for p in Path(out).glob("*/report.json")))
            (Path(out) / "scenes.npz").unlink()
            fixed = _vatmart(*command)
        control[jobs].append(_control(jobs))
    one, two = sum(wall[1]) / 2, sum(wall[2]) / 2
    return {
        "seconds": tta_transforms(values),
        "within_15": share(values, 15),
        "slowest": {k: seconds[k] for k in slow},
        "two_against_one": {
            "objects": len(names),
            "wall_seconds": _by_processes(wall),
            "start_up_and_banks": _round(fixed),
            "core_seconds": _by_processes(core),
            "control_seconds": _by_processes(control),
            "times_as_fast": _round(one / two),
            "times_as_fast_without_start_up_and_banks": _round((one - fixed) / (two - fixed)),
            "times_as_fast_control": _round(2 * sum(control[1]) / sum(control[2])),
        },
    }


def _by_processes(seconds: dict[int, list[float]]) -> dict[str, list[float]]:
    return {"one": [_round(s) for s in seconds[1]], "two": [_round(s) for s in seconds[2]]}


CONTROL = """
import time, numpy as np
from scipy.spatial import ConvexHull
start, a = time.perf_counter(), np.random.default_rng(0).normal(size=(20000, 3))
for _ in range(250):
    ConvexHull(a)
    np.unique(np.round(a, 2), axis=0)
    sum(i * i for i in range(100_000))
print(time.perf_counter() - start)
"""


def _control(processes: int) -> float:
    """Seconds of the same work, nothing shared, in so many processes at once; start-up left out."""
    environment = os.environ | dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    started = [
        subprocess.Popen([sys.executable, "-c", CONTROL], env=environment, stdout=subprocess.PIPE, text=True)
        for _ in range(processes)
    ]
    return max(float(p.communicate()[0]) for p in started)


def again(check: Check) -> dict[str, Any]:
    """5: a second run of the whole set, which finds everything up to date (same flags as the first)."""
    config = json.loads((check.out / "convert.json").read_text())["config"]
    default = _flat(asdict(ConvertConfig()))
    changed = {k: v for k, v in _flat(config).items() if v != default[k]}
    flags = [w for k, v in changed.items() for w in ((f"--{k.replace('_', '-')}",) if v is True else
             (f"--{k.replace('_', '-')}", str(v)))]  # fmt: skip
    before = {p: p.stat().st_mtime_ns for p in check.out.glob("*/*")}
    seconds = _vatmart("convert", check.src, "--out", check.out, *flags)
    same = before == {p: p.stat().st_mtime_ns for p in check.out.glob("*/*")}
    return {"seconds": round(seconds, 2), "nothing_written": same}


def _flat(config: dict[str, Any]) -> dict[str, Any]:
    """Flags and their values of a nested config."""
    out = {}
    for name, value in config.items():
        out |= value if isinstance(value, dict) else {name: value}
    return out


def _vatmart(*words: str | Path) -> float:
    """Seconds that the command takes."""
    command = [sys.executable, "-m", "vatmart_jax.cli.main", *map(str, words)]
    start = time.monotonic()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return time.monotonic() - start


def rendering(check: Check, scenes: int = 48, per_scene: int = 2, points: int = 10_000, rays: int = 300) -> dict:
    """6: views per second on two processes; depth and mask by MuJoCo's rays; distance to the visual surface."""
    bank = SceneBank.load(check.out / "scenes.npz")
    config = json.loads((check.out / "convert.json").read_text())["config"]
    names = sorted(set(bank.object_id.tolist()) & set(check.only or bank.object_id.tolist()))
    names = names[:: max(1, len(bank) // scenes)]
    loaded = [ConvertedObject.load(check.out / name) for name in names]
    specs = [spec for converted in loaded for spec in scene_specs(converted, config["variants"], config["seed"])]
    view = ViewConfig(views=per_scene, train_factor=1, points=points)
    start = time.monotonic()
    found, without = render_views(loaded, config["variants"], config["seed"], view, jobs=2)
    seconds = time.monotonic() - start
    agree, depth, away = [], [], []
    rng = np.random.default_rng(check.seed)
    for v in range(0, len(found), per_scene):
        spec = specs[int(found.scene[v])]
        converted, part = spec.converted, spec.part
        closed = {**spec.values, part.joint: part.closed}
        values = closed | {part.joint: part.closed + part.sign * float(found.joint_pos[v])}
        corners = _surface(converted, closed).vertices
        centre = (corners.min(axis=0) + corners.max(axis=0)) / 2
        eye = Camera.looking_at(centre, found.azimuth[v], found.elevation[v], DISTANCE).position
        some_points = rng.choice(len(found.points[v]), rays)
        cloud = found.points[v][some_points].astype(float)
        distance, moves = _cast(check.out / converted.obj.id / "model.xml", converted, part.link, values, eye, cloud)
        reached = np.abs(distance - np.linalg.norm(cloud - eye, axis=1)) < 5e-3
        depth.append(reached.mean())
        agree.append((moves == found.part_mask[v][some_points])[reached].mean())
        away.append(trimesh.proximity.closest_point(_surface(converted, values), cloud[:100])[1].max())
    return {
        "views": len(found),
        "points": points,
        "seconds": round(seconds, 2),
        "views_per_second": round(len(found) / seconds, 2),
        "scenes_without_views": [why for _, why in without],
        "checked_views": len(agree),
        "mask_agrees": {"mean": _round(float(np.mean(agree))), "min": _round(min(agree))},
        "depth_agrees": {"mean": _round(float(np.mean(depth))), "min": _round(min(depth))},
        "distance_to_surface_max": _round(max(away)),
    }


def _surface(converted: ConvertedObject, values: dict[str, float]) -> trimesh.Trimesh:
    poses = converted.obj.link_poses(values)
    return _mesh([
        (x.vertices @ poses[k][:3, :3].T + poses[k][:3, 3])[x.faces]
        for k, link in converted.obj.links.items()
        for x in link.visuals
    ])  # fmt: skip


def _mesh(triangles: list[np.ndarray]) -> trimesh.Trimesh:
    corners = np.concatenate(triangles).reshape(-1, 3)
    return trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)


def _cast(
    path: Path, converted: ConvertedObject, link: str, values: dict[str, float], eye: np.ndarray, towards: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """By MuJoCo: distance [n] of the first visual on the way to each point, and whether it moves with the link."""
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    for name, value in values.items():
        data.qpos[model.joint(name).qposadr[0]] = value
    mujoco.mj_kinematics(model, data)
    own = {model.body("world_" if k == "world" else k).id for k in converted.obj.subtree(link)}
    group = np.array([k == VISUAL_GROUP for k in range(6)], np.uint8)
    geom = np.zeros(1, np.int32)
    distance, moves = [], []
    for point in towards:
        ray = (point - eye) / np.linalg.norm(point - eye)
        distance.append(mujoco.mj_ray(model, data, eye, ray, group, 1, -1, geom))
        moves.append(geom[0] >= 0 and int(model.geom_bodyid[geom[0]]) in own)
    return np.array(distance), np.array(moves)


def steps(check: Check) -> dict[str, Any]:
    """8: 1,000 steps with every joint swinging from limit to limit, and mjx.put_model."""
    from mujoco import mjx

    warned, refused, swept = [], {}, []
    for r in check.reports():
        model = mujoco.MjModel.from_xml_path(str(check.out / r["id"] / "model.xml"))
        data = mujoco.MjData(model)
        limited = model.jnt_limited.astype(bool)
        low, high = np.where(limited, model.jnt_range[:, 0], -3.0), np.where(limited, model.jnt_range[:, 1], 3.0)
        if model.nv:
            data.qpos[:] = low
        passed = []
        for step in range(1000):
            goal = low + (high - low) * (0.5 - 0.55 * np.cos(step * model.opt.timestep * 2 * np.pi))
            data.qacc[:] = 900 * (goal - data.qpos) - 60 * data.qvel
            mujoco.mj_inverse(model, data)
            data.qfrc_applied[:] = data.qfrc_inverse
            mujoco.mj_step(model, data)
            passed.append(data.qpos.copy())
        if any(w.number for w in data.warning) or not np.isfinite(passed).all():
            warned.append(r["id"])
        if model.nv:
            swept.append(float((np.ptp(passed, axis=0) / (high - low)).min()))
        try:
            mjx.put_model(model)
        except Exception as e:  # whatever MJX does not take
            refused[r["id"]] = f"{type(e).__name__}: {e}"
    return {
        "objects": len(check.reports()),
        "warned": warned,
        "share_of_range_swept_min": _round(min(swept)),
        "mjx_refused": refused,
    }


def fuzz(check: Check, folders: range = range(200)) -> dict[str, Any]:
    """9: mutated folders, each converted or refused in one line, and nothing written but in the out folder."""
    small = [r["id"] for r in sorted(check.reports(), key=lambda r: r["seconds"])[:40]]
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        (root / "src").mkdir()
        (root / "secret.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
        did = {}
        for i in folders:
            folder = root / "src" / f"{i:03d}"
            shutil.copytree(check.src / small[i % len(small)], folder)
            mutate = MUTATIONS[i % len(MUTATIONS)]
            did[folder.name] = mutate.__name__
            mutate(folder, np.random.default_rng((check.seed, i)))
        before = _listing(root)
        start = time.monotonic()
        result = convert([root / "src"], root / "out", ConvertConfig(view=ViewConfig(views=0), time_limit=60), jobs=2)
        seconds = time.monotonic() - start
        after = {k: v for k, v in _listing(root).items() if not k.startswith("out/")}
        unclear = [f for f in result.failed if "\n" in f["reason"] or len(f["reason"]) > 300 or _crash(f["reason"])]
        reasons: dict[str, int] = {}
        outcome: dict[str, list[int]] = {}
        refused = {f["id"] for f in result.failed}
        for key, mutation in did.items():
            outcome.setdefault(mutation, [0, 0])[key in refused] += 1
        for f in result.failed:
            short = re.sub(r"^\d+/[^:]*", "FILE", re.sub(r"'[^']*'|-?\d[\d.e+-]*", "_", f["reason"]))[:70]
            reasons[short] = reasons.get(short, 0) + 1
        return {
            "folders": len(folders),
            "converted": result.converted,
            "refused": len(result.failed),
            "unclear": [{**f, "mutation": did[f["id"]]} for f in unclear],
            "files_outside_untouched": before == after,
            "converted_refused_by_mutation": outcome,
            "seconds": round(seconds, 1),
        }


def _listing(root: Path) -> dict[str, str]:
    """Every file below root and a hash of it; links as what they point to."""
    out = {}
    for p in sorted(root.rglob("*")):
        key = str(p.relative_to(root))
        if p.is_symlink():
            out[key] = f"-> {p.readlink()}"
        elif p.is_file():
            out[key] = hashlib.sha256(p.read_bytes()).hexdigest()
    return out


def _urdf(folder: Path) -> Path:
    return next(folder / n for n in URDF_NAMES if (folder / n).exists())


def _some_mesh(folder: Path, rng: np.random.Generator) -> Path:
    meshes = sorted(folder.glob("textured_objs/*.obj"))
    return meshes[rng.integers(len(meshes))]


def _substitute(path: Path, pattern: str, new: str | Callable[[re.Match], str], rng: np.random.Generator) -> None:
    """Replace one match, chosen at random; the file stays as it is where there is none."""
    text = path.read_text(errors="replace")
    found = list(re.finditer(pattern, text))
    if found:
        m = found[rng.integers(len(found))]
        path.write_text(text[: m.start()] + (new(m) if callable(new) else new) + text[m.end() :])


NUMBER = r"-?\d+\.\d+(?:e-?\d+)?"


def truncated_urdf(folder: Path, rng: np.random.Generator) -> None:
    data = _urdf(folder).read_bytes()
    _urdf(folder).write_bytes(data[: rng.integers(len(data))])


def truncated_mesh(folder: Path, rng: np.random.Generator) -> None:
    path = _some_mesh(folder, rng)
    path.write_bytes(path.read_bytes()[: rng.integers(path.stat().st_size)])


def swapped_numbers(folder: Path, rng: np.random.Generator) -> None:
    path = _urdf(folder)
    text = path.read_text()
    found = list(re.finditer(NUMBER, text))
    a, b = sorted(rng.choice(len(found), 2, replace=False))
    a, b = found[a], found[b]
    path.write_text(text[: a.start()] + b[0] + text[a.end() : b.start()] + a[0] + text[b.end() :])


def removed_link(folder: Path, rng: np.random.Generator) -> None:
    _substitute(_urdf(folder), r"(?s)<link name=.*?(?:</link>|/>)", "", rng)


def removed_joint(folder: Path, rng: np.random.Generator) -> None:
    _substitute(_urdf(folder), r"(?s)<joint name=.*?</joint>", "", rng)


def not_a_number(folder: Path, rng: np.random.Generator) -> None:
    _substitute(_urdf(folder), NUMBER, str(rng.choice(["nan", "inf", "-inf", "1e999", "x", ""])), rng)


def mesh_not_a_number(folder: Path, rng: np.random.Generator) -> None:
    _substitute(_some_mesh(folder, rng), NUMBER, str(rng.choice(["nan", "inf", "1e400", "abc"])), rng)


def huge_coordinates(folder: Path, rng: np.random.Generator) -> None:
    _substitute(_some_mesh(folder, rng), NUMBER, str(rng.choice(["1e30", "1e8", "-1e300", "500.0", "999999"])), rng)


def huge_joint(folder: Path, rng: np.random.Generator) -> None:
    _substitute(_urdf(folder), NUMBER, str(rng.choice(["1e30", "1e300", "-1e8", "123456.0"])), rng)


def path_upwards(folder: Path, rng: np.random.Generator) -> None:
    _substitute(_urdf(folder), r'filename="[^"]*"', 'filename="../../secret.obj"', rng)


def absolute_path(folder: Path, rng: np.random.Generator) -> None:
    _substitute(_urdf(folder), r'filename="[^"]*"', f'filename="{folder.parents[1] / "secret.obj"}"', rng)


def link_outwards(folder: Path, rng: np.random.Generator) -> None:
    path = _some_mesh(folder, rng)
    path.unlink()
    path.symlink_to(folder.parents[1] / "secret.obj")


def link_to_itself(folder: Path, rng: np.random.Generator) -> None:
    path = _some_mesh(folder, rng)
    path.unlink()
    path.symlink_to(path)


def linked_urdf(folder: Path, rng: np.random.Generator) -> None:
    path = _urdf(folder)
    (folder.parents[1] / f"{folder.name}.urdf").write_bytes(path.read_bytes())
    path.unlink()
    path.symlink_to(folder.parents[1] / f"{folder.name}.urdf")


def missing_mesh(folder: Path, rng: np.random.Generator) -> None:
    _some_mesh(folder, rng).unlink()


def missing_annotation(folder: Path, rng: np.random.Generator) -> None:
    for path in sorted(folder.glob("*.json")) + sorted(folder.glob("*.txt")):
        if rng.random() < 0.7:
            path.unlink()


def broken_annotation(folder: Path, rng: np.random.Generator) -> None:
    for path in sorted(folder.glob("*.json")) + sorted(folder.glob("*.txt")):
        data = path.read_bytes()
        path.write_bytes(rng.choice([data[: len(data) // 2], b"\xff\xfe\x00", b"[" * 5000, b"[1, {}]", b"7"]))


def garbage_mesh(folder: Path, rng: np.random.Generator) -> None:
    _some_mesh(folder, rng).write_bytes(rng.bytes(3000))


def wrong_face(folder: Path, rng: np.random.Generator) -> None:
    _substitute(
        _some_mesh(folder, rng), r"(?m)^f \S+", str(rng.choice(["f 0", "f 99999999", "f -99999", "f 1.5"])), rng
    )


def looped_joint(folder: Path, rng: np.random.Generator) -> None:
    _substitute(_urdf(folder), r'<parent link="[^"]*"', '<parent link="link_0"', rng)


def twin_names(folder: Path, rng: np.random.Generator) -> None:
    _substitute(_urdf(folder), r'<link name="[^"]*"', '<link name="base"', rng)


def odd_name(folder: Path, rng: np.random.Generator) -> None:
    odd = str(rng.choice(["../../x", "/etc/passwd", "a b", "&lt;x&gt;", "ä&#10;ö", "x" * 3000, "world"]))
    path = _urdf(folder)
    path.write_text(path.read_text().replace('"link_0"', f'"{odd}"'))


def unknown_type(folder: Path, rng: np.random.Generator) -> None:
    new = str(rng.choice(["floating", "planar", "door", "", "fixed", "continuous", "prismatic"]))
    _substitute(_urdf(folder), r'type="[a-z]+"', f'type="{new}"', rng)


def zero_axis(folder: Path, rng: np.random.Generator) -> None:
    _substitute(
        _urdf(folder), r'<axis xyz="[^"]*"', f'<axis xyz="{rng.choice(["0 0 0", "1 0", "1 2 3 4", "a b c"])}"', rng
    )


def bomb(folder: Path, rng: np.random.Generator) -> None:
    entities = "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 9))
    body = f'<!DOCTYPE r [<!ENTITY a0 "x">{entities}]><robot name="&a8;"></robot>'
    outside = '<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/passwd">]><robot name="r"><link name="&x;"/></robot>'
    _urdf(folder).write_text(str(rng.choice([body, outside])))


MUTATIONS = (
    truncated_urdf, truncated_mesh, swapped_numbers, removed_link, removed_joint, not_a_number, mesh_not_a_number,
    huge_coordinates, huge_joint, path_upwards, absolute_path, link_outwards, link_to_itself, linked_urdf, missing_mesh,
    missing_annotation, broken_annotation, garbage_mesh, wrong_face, looped_joint, twin_names, odd_name, unknown_type,
    zero_axis, bomb,
)  # fmt: skip
CHECKS: dict[str, Callable[[Check], dict[str, Any]]] = {
    f.__name__: f for f in (objects, kinematics, fidelity, sight, budget, again, speed, rendering, steps, fuzz)
}


def main(names: tyro.conf.Positional[tuple[str, ...]], check: Annotated[Check, tyro.conf.arg(name="")]) -> None:
    """Run the named checks (`all`: every one) and merge what they measured into the results file."""
    unknown = set(names) - {*CHECKS, "all"}
    if unknown or not names:
        sys.exit(f"{', '.join(sorted(unknown)) or 'no check named'}: choose from all, {', '.join(CHECKS)}")
    for name in CHECKS if "all" in names else names:
        start = time.monotonic()
        found = CHECKS[name](replace(check))
        measured = json.loads(check.results.read_text()) if check.results.is_file() else {}
        check.results.parent.mkdir(parents=True, exist_ok=True)
        check.results.write_text(json.dumps(measured | {name: found}, indent=1) + "\n")
        print(f"{name} ({time.monotonic() - start:.1f} s)", json.dumps(found, indent=1))


if __name__ == "__main__":
    tyro.cli(main)
