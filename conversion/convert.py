"""PartNet-Mobility folders -> one folder per object, and the banks that training reads.

Out folder: `<id>/` with model.xml, assets/, object.npz, report.json, picture.png for each object; scenes.npz and
views.npz; splits.json; convert.json with what was asked and what was refused.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import multiprocessing
import os
import shutil
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from functools import cache
from importlib.metadata import version
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from conversion import partnet
from conversion.boxes import boxes
from conversion.budget import joined, within_budget
from conversion.decompose import DecomposeConfig, Surface, decompose, fidelity
from conversion.handles import shapes
from conversion.mjcf import MjcfConfig, to_mjcf
from conversion.partnet import ConvertedObject, ObjectError
from conversion.report import contact_sheet, page, picture, read_png, save_png
from conversion.scenes import scene_bank
from conversion.textures import read_mtl
from conversion.views import views
from vatmart_jax.atomic_io import whole_folder, write_json, write_text
from vatmart_jax.data.banks import SceneBank

URDF_NAMES = ("mobility.urdf", "mobility_vhacd.urdf")
TRAIN_CATEGORIES = ("StorageFurniture", "Door", "Microwave", "Refrigerator")  # paper, section 4.1
TEST_CATEGORIES = ("Safe", "Table", "WashingMachine")
SPLITS = ("train", "test_shapes", "test_categories", "extra")
_SOURCE_SUFFIXES = (".urdf", ".json", ".txt", ".obj", ".stl", ".ply")
_TEXTURE_SUFFIXES = (".mtl", ".png", ".jpg", ".jpeg", ".bmp", ".gif")


@dataclass(frozen=True)
class ViewConfig:
    """What views are made with; changing it leaves converted objects as they are."""

    views: int = 6
    """Views of every Scene for a push task, and as many for a pull task."""
    train_factor: int = 3
    """Training Scenes get so many times as many: the networks learn a few views by heart."""
    points: int = 4096
    """Points per view; the paper has 10,000."""
    contacts: int = 128
    """Further pixels of the moving part per view: where a trial may touch."""


@dataclass(frozen=True)
class ConvertConfig(DecomposeConfig, MjcfConfig, ViewConfig):
    part_budget: int = 16
    """Hulls per moving link; in a Scene, of all that moves with its part."""
    static_budget: int = 32
    """Hulls of all that is fixed to the world; in a Scene, of all that stands still."""
    variants: int = 2
    """Scenes per door or drawer: all other parts closed, then with some of them open."""
    allow_missing: bool = False
    """Convert links that lack more than half of their meshes, too, without these. Fewer are left out and noted."""
    textures: bool = False
    """Carry materials and images of the OBJ files over to model.xml; without, links have colours by role."""
    continuous_range: bool = False
    """Let joints without a limit turn or slide without end, instead of refusing the object."""
    time_limit: float = 120.0
    """Seconds per object; one that takes longer is refused."""
    collision: Literal["hull", "box"] = "hull"
    """Collision geometry: convex hulls, or oriented boxes, which MJX is fast with."""
    seed: int = 0
    """Of everything random in the conversion."""


@dataclass(frozen=True)
class ConvertResult:
    objects: int  # folders found
    converted: int  # of them in the out folder now, whether made by this call or up to date
    failed: list[dict[str, str]]  # id, reason
    seconds: float


def convert(sources: Sequence[Path], out: Path, config: ConvertConfig, jobs: int | None = None) -> ConvertResult:
    """Convert object folders, or folders of such folders. jobs: processes, default one per core.

    What is up to date (same files, configuration, library versions) is left as it is. An object that cannot be
    converted is listed in the result, and its folder of an earlier run removed. Raises ObjectError where nothing could
    be converted at all.
    """
    start, jobs = time.monotonic(), jobs or os.cpu_count() or 1
    folders = _object_folders(sources, out)
    splits = _splits(sources)
    keys = {f: _key(f, config, splits.get(f.resolve().name)) for f in folders}
    out.mkdir(parents=True, exist_ok=True)
    record = _read_json(out / "convert.json")
    refused = {r["id"]: r for r in record.get("failed", ()) if r.get("key") in keys.values()}
    current: dict[str, str] = {}  # id -> key
    failed: dict[str, dict[str, str]] = {}
    work = []
    for folder in folders:
        name, key = folder.resolve().name, keys[folder]
        if name in current or name in failed or any(name == f.resolve().name for f in work):
            continue
        if name in refused and refused[name]["key"] == key:
            failed[name] = refused[name]
        elif _read_json(out / name / "report.json").get("key") == key:
            current[name] = key
        else:
            work.append(folder)
    # The largest first, or one process works on it while the others have nothing left.
    work.sort(key=lambda f: -sum(p.stat().st_size for p in f.rglob("*.obj") if p.is_file()))
    # Resolved, so that a folder given as `.` has a name.
    tasks = [(f.resolve(), out, config, splits.get(f.resolve().name), keys[f]) for f in work]
    for (folder, *_, key), error in _pool(_convert_one, tasks, jobs, config.time_limit):
        name = folder.name
        if error is None:
            current[name] = key
        else:
            failed[name] = {"id": name, "reason": error, "key": key}
            shutil.rmtree(out / name, ignore_errors=True)
    failures = [failed[k] for k in sorted(failed)]
    if not current:
        if not any(out.iterdir()):
            out.rmdir()
        more = f" (and {len(failures) - 1} more objects refused)" if len(failures) > 1 else ""
        raise ObjectError(failures[0]["reason"] + more)
    banks = _banks(out, current, failures, config, jobs, record.get("banks", {}))
    settings = {"config": asdict(config), "versions": _versions(), "failed": failures, "banks": banks}
    write_json(out / "convert.json", settings)
    reasons = [{"id": f["id"], "reason": f["reason"]} for f in failures]
    return ConvertResult(len(current) + len(failed), len(current), reasons, time.monotonic() - start)


def _object_folders(sources: Sequence[Path], out: Path) -> list[Path]:
    folders = []
    for source in sources:
        if not source.is_dir():
            raise ObjectError(f"{source}: no such folder; name PartNet-Mobility object folders or a folder of them")
        is_object = lambda p: any((p / n).exists() for n in URDF_NAMES)  # noqa: E731
        inside = sorted(p for p in source.iterdir() if p.is_dir() and not p.name.startswith("."))
        if is_object(source) or not any(is_object(p) for p in inside):
            folders.append(source)
        else:
            folders += [p for p in inside if p.resolve() != out.resolve()]
    return folders


def _key(folder: Path, config: ConvertConfig, split: str | None) -> str:
    """Hash of all that a conversion depends on."""
    others = {f.name for f in fields(ViewConfig)} | {"time_limit"}
    settings = {name: value for name, value in asdict(config).items() if name not in others}
    digest = hashlib.sha256(json.dumps([settings, split, _versions()], sort_keys=True).encode())
    digest.update(_source())
    suffixes = _SOURCE_SUFFIXES + (_TEXTURE_SUFFIXES if config.textures else ())
    for path in sorted(folder.rglob("*")):
        if path.suffix.lower() in suffixes and path.is_file():
            digest.update(str(path.relative_to(folder)).encode())
            # A link out of the folder is refused later and not read now.
            if path.resolve().is_relative_to(folder.resolve()):
                digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:32]


@cache
def _source() -> bytes:
    """Of the modules that an object's conversion runs."""
    functions = (partnet.read_object, read_mtl, decompose, boxes, to_mjcf, scene_bank, within_budget, shapes)
    return "".join(inspect.getsource(sys.modules[f.__module__]) for f in functions).encode()


@cache
def _versions() -> dict[str, str]:
    return {name: version(name) for name in ("vatmart-jax", "numpy", "scipy", "trimesh", "coacd", "mujoco")}


def _splits(sources: Sequence[Path]) -> dict[str, str]:
    """Split by object id, from splits.json in a source folder or beside it."""
    out: dict[str, str] = {}
    for source in sources:
        for folder in (source, source.parent):
            table = _read_json(folder / "splits.json")
            for split in SPLITS:
                for ids in (table.get(split) or {}).values():
                    out.update({str(i): split for i in ids})
    return out


def default_split(category: str, object_id: str) -> str:
    """The paper's categories; of the training ones, one object in five (by a hash of its id) is a test shape."""
    if category in TEST_CATEGORIES:
        return "test_categories"
    if category not in TRAIN_CATEGORIES:
        return "extra"
    return "test_shapes" if hashlib.sha256(object_id.encode()).digest()[0] % 5 == 0 else "train"


def _convert_one(folder: Path, out: Path, config: ConvertConfig, split: str | None, key: str) -> None:
    """One object folder, complete or not at all."""
    start = time.process_time()
    obj = partnet.read_object(
        folder,
        continuous_range=config.continuous_range,
        allow_missing=config.allow_missing,
        textures=config.textures,
    )
    parts, left_out = partnet.parts(obj)
    hulls, groups, found = {}, {}, []
    for root in obj.groups:
        budget = config.static_budget if root == obj.root else config.part_budget
        hulls[root] = []
        if visuals := obj.group_visuals(root):
            surface = Surface(visuals, config.seed)
            part = next((p for p in parts if p.link == root), None)
            hulls[root], passable = shapes(obj, part, surface, budget, config.collision, config)
            found += passable
            groups[root] = {"hulls": len(hulls[root]), "budget": budget, **asdict(fidelity(surface, hulls[root]))}
    split = split or default_split(obj.category, obj.id)
    converted = ConvertedObject(obj, hulls, parts, left_out, split)
    mjcf = to_mjcf(converted, config)
    try:
        mjcf.compile()
    except ObjectError as e:
        raise ObjectError(f"{obj.id}: {e}") from None
    bank = scene_bank([converted], config.variants, config.collision, config.seed)
    bank, slots = within_budget(bank, converted, config.static_budget, config.part_budget, config, config.seed)
    report = {
        "id": obj.id,
        "category": obj.category,
        "split": split,
        "key": key,
        "parts": [asdict(p) for p in parts],
        "left_out": [{"joint": j, "reason": why} for j, why in left_out],
        "notes": obj.notes,
        "groups": groups,
        "handles": [asdict(h) for h in found],
        "scenes": len(bank),
        "merged_scenes": [asdict(s) for s in slots],
        "seconds": round(time.process_time() - start, 3),  # of one core
    }
    with whole_folder(out / obj.id) as part:
        mjcf.write(part)
        converted.save(part)
        bank.save(part / "scenes.npz")
        save_png(part / "picture.png", picture(converted))
        write_json(part / "report.json", report)


def _banks(
    out: Path,
    current: dict[str, str],
    failed: list[dict[str, str]],
    config: ConvertConfig,
    jobs: int,
    made: dict[str, Any],
) -> dict[str, Any]:
    """Write what describes the current objects together, unless `made` (returned earlier) fits them.

    That is splits.json, scenes.npz, views.npz, report.html and contact_sheet.png. Returns the key of what was made, and
    why Scenes have no views.
    """
    key = hashlib.sha256(json.dumps([asdict(config), sorted(current.items()), failed]).encode()).hexdigest()
    files = ("splits.json", "scenes.npz", "views.npz", "report.html", "contact_sheet.png")
    if key == made.get("key") and all((out / f).is_file() for f in files):
        return made
    names = sorted(current)
    objects = [ConvertedObject.load(out / name) for name in names]
    table: dict[str, dict[str, list[str]]] = {split: {} for split in SPLITS}
    for o in objects:
        table[o.split].setdefault(o.obj.category, []).append(o.obj.id)
    write_json(out / "splits.json", table)
    joined([SceneBank.load(out / name / "scenes.npz") for name in names]).save(out / "scenes.npz")
    links = scene_bank(objects, config.variants, config.collision, config.seed)
    per_scene = config.views * np.where(links.split == "train", config.train_factor, 1)
    found, without = views(objects, links, per_scene, config.points, config.contacts, config.seed, jobs)
    found.save(out / "views.npz")
    without_views = [why for _, why in without]
    reports = [_read_json(out / name / "report.json") for name in names]
    write_text(out / "report.html", page(reports, failed, without_views))
    pictures = [read_png(out / name / "picture.png") for name in names]
    save_png(out / "contact_sheet.png", contact_sheet(pictures, max(1, round(len(pictures) ** 0.5 / 2))))
    return {"key": key, "without_views": without_views}


def _pool(
    function: Callable[..., None], tasks: Sequence[tuple], jobs: int, time_limit: float
) -> Iterator[tuple[tuple, str | None]]:
    """Run function(*task) in processes of our own; yields each task with its error, None where it went well.

    Unlike a pool of the standard library it survives a process that dies or hangs: only that task fails.
    """
    context = multiprocessing.get_context("spawn")
    waiting = list(reversed(tasks))
    busy: dict[Connection, tuple[Any, tuple, float]] = {}
    idle: list[tuple[Any, Connection]] = []
    # One thread each: the processes are the parallelism.
    saved = {k: os.environ.get(k) for k in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
    os.environ.update(dict.fromkeys(saved, "1"))
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    progress = Progress(*columns, console=Console(stderr=True), transient=True)
    bar = progress.add_task("Converting", total=len(tasks))
    try:
        with progress:
            while waiting or busy:
                while waiting and len(busy) < jobs:
                    if idle:
                        process, pipe = idle.pop()
                    else:
                        pipe, theirs = context.Pipe()
                        process = context.Process(target=_serve, args=(function, theirs), daemon=True)
                        process.start()
                        theirs.close()
                    task = waiting.pop()
                    pipe.send(task)
                    busy[pipe] = process, task, time.monotonic() + time_limit
                nearest = min(deadline for _, _, deadline in busy.values())
                ready = wait(list(busy), timeout=max(0.0, nearest - time.monotonic()))
                for pipe in list(busy):
                    process, task, deadline = busy[pipe]
                    if pipe in ready:
                        try:
                            error = pipe.recv()
                            idle.append((process, pipe))
                        except EOFError:
                            process.join()
                            error = f"{task[0].name}: the process died (exit code {process.exitcode})"
                    elif time.monotonic() > deadline:
                        process.kill()
                        process.join()
                        error = f"{task[0].name}: took longer than {time_limit:g} s; raise --time-limit"
                    else:
                        continue
                    del busy[pipe]
                    progress.advance(bar)
                    yield task, error
    finally:
        for process, _ in idle:
            process.kill()
        for process, _, _ in busy.values():
            process.kill()
        for key, value in saved.items():
            os.environ.pop(key, None) if value is None else os.environ.update({key: value})


def _serve(function: Callable[..., None], pipe: Connection) -> None:
    while True:
        try:
            task = pipe.recv()
        except EOFError:
            return
        error = None
        try:
            function(*task)
        except ObjectError as e:
            error = str(e)
        except Exception as e:  # whatever one object does, the others go on
            where = traceback.extract_tb(e.__traceback__)[-1]
            error = f"{task[0].name}: {type(e).__name__}: {e} ({Path(where.filename).name}:{where.lineno})"
        try:
            pipe.send(error)
        except BrokenPipeError:  # the other end was killed
            return


def _read_json(path: Path) -> dict[str, Any]:
    """{} where the file is missing or broken: it is made again."""
    try:
        out = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return out if isinstance(out, dict) else {}
