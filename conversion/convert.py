"""Object folders -> one folder per object, and the banks that training reads.

Out folder: `<id>/` with model.xml, assets/, object.npz, scenes.npz, report.json, picture.png for each object;
scenes.npz and views.npz of all; splits.json; report.html and contact_sheet.png; convert.json with the configuration and
what was refused. Everything is there complete or not at all.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from conversion.cache_key import hash_of, library_versions, object_key, views_key
from conversion.collision_geometry import collision_geometry
from conversion.config import ConvertConfig
from conversion.fidelity import measure_fidelity
from conversion.mjcf import to_mjcf
from conversion.model import ConvertedObject, ObjectError
from conversion.part_detection import detect_parts
from conversion.preview import contact_sheet, read_png, render_preview, save_png
from conversion.readers import is_object, read_object, reader_of
from conversion.render_views import render_views
from conversion.report import html_report
from conversion.scene_budget import within_budget
from conversion.scenes import scene_bank, scene_specs
from conversion.splits import SPLITS, default_split, read_json, read_splits
from conversion.surface import Surface
from conversion.worker_pool import run_tasks
from vatmart_jax.atomic_io import atomic_directory, write_json, write_text
from vatmart_jax.data.banks import SceneBank
from vatmart_jax.registry import load_plugins


@dataclass(frozen=True, kw_only=True)
class ConvertResult:
    objects: int  # folders found
    converted: int  # of them in the out folder now, whether made by this call or up to date
    failed: list[dict[str, str]]  # id, reason
    seconds: float


def convert(sources: Sequence[Path], out: Path, config: ConvertConfig, jobs: int | None = None) -> ConvertResult:
    """Convert object folders, or folders of such folders. jobs: processes, default one per core.

    What is up to date (same files, configuration, versions) is left as it is. An object that cannot be converted is
    listed in the result, and its folder of an earlier run removed; one that ran out of time or crashed is tried again
    by the next call. Raises ObjectError where nothing could be converted at all.
    """
    start, jobs = time.monotonic(), jobs or os.cpu_count() or 1
    load_plugins()
    folders: dict[str, Path] = {}
    for folder in _object_folders(sources, out):
        folders.setdefault(folder.resolve().name, folder)
    splits = read_splits(sources)
    keys = {name: object_key(f, reader_of(f), config, splits.get(name)) for name, f in folders.items()}
    out.mkdir(parents=True, exist_ok=True)
    record = read_json(out / "convert.json")
    refused = {r["id"]: r for r in record.get("failed", ())}
    failed = {n: refused[n] for n, key in keys.items() if n in refused and refused[n].get("key") == key}
    rest = [n for n in keys if n not in failed]
    current = {n: keys[n] for n in rest if read_json(out / n / "report.json").get("key") == keys[n]}
    work = [n for n in rest if n not in current]
    # The largest first, or one process works on it while the others have nothing left.
    work.sort(key=lambda name: -sum(p.stat().st_size for p in folders[name].rglob("*.obj") if p.is_file()))
    # Resolved, so that a folder given as `.` has a name.
    tasks = [(folders[n].resolve(), out, config, splits.get(n), keys[n]) for n in work]
    for task, outcome in run_tasks(convert_object, tasks, jobs, label="Converting", cpu_limit=config.time_limit):
        name = task[0].name
        if outcome.error is None:
            current[name] = keys[name]
            continue
        failed[name] = {"id": name, "reason": outcome.error}
        if outcome.transient:
            failed[name]["reason"] = f"{name}: {outcome.error}"
        else:
            failed[name]["key"] = keys[name]
        shutil.rmtree(out / name, ignore_errors=True)
    failures = [failed[name] for name in sorted(failed)]
    if not current:
        if not any(out.iterdir()):
            out.rmdir()
        more = f" (and {len(failures) - 1} more objects refused)" if len(failures) > 1 else ""
        raise ObjectError(failures[0]["reason"] + more)
    banks = _write_banks(out, current, failures, config, jobs, record.get("banks", {}))
    settings = {"config": asdict(config), "versions": library_versions(), "failed": failures, "banks": banks}
    write_json(out / "convert.json", settings)
    return ConvertResult(
        objects=len(current) + len(failed),
        converted=len(current),
        failed=[{"id": f["id"], "reason": f["reason"]} for f in failures],
        seconds=time.monotonic() - start,
    )


def _object_folders(sources: Sequence[Path], out: Path) -> list[Path]:
    folders = []
    for source in sources:
        if not source.is_dir():
            raise ObjectError(f"{source}: no such folder; name PartNet-Mobility object folders or a folder of them")
        inside = sorted(p for p in source.iterdir() if p.is_dir() and not p.name.startswith("."))
        if is_object(source) or not any(is_object(p) for p in inside):
            folders.append(source)
        else:
            folders += [p for p in inside if p.resolve() != out.resolve()]
    return folders


def convert_object(folder: Path, out: Path, config: ConvertConfig, split: str | None, key: str) -> None:
    """One object folder to `out`/<id>, complete or not at all. Raises ObjectError."""
    start = time.process_time()
    obj = read_object(folder, config.read)
    parts, left_out = detect_parts(obj)
    hulls, groups, handles = {}, {}, []
    for root in obj.groups:
        budget = config.decompose.static_budget if root == obj.root else config.decompose.part_budget
        hulls[root] = []
        if visuals := obj.group_visuals(root):
            surface = Surface(visuals, config.seed)
            part = next((p for p in parts if p.link == root), None)
            hulls[root], found = collision_geometry(obj, part, surface, budget, config.decompose)
            handles += found
            match = measure_fidelity(surface, hulls[root])
            groups[root] = {"hulls": len(hulls[root]), "budget": budget, **asdict(match)}
    split = split or default_split(obj.category, obj.id)
    converted = ConvertedObject(obj=obj, hulls=hulls, parts=parts, left_out=left_out, split=split)
    mjcf = to_mjcf(converted, config.mjcf)
    try:
        mjcf.compile()
    except ObjectError as e:
        raise ObjectError(f"{obj.id}: {e}") from None
    specs = scene_specs(converted, config.variants, config.seed)
    bank, merged = within_budget(scene_bank(specs, config.decompose.collision), specs, config.decompose, config.seed)
    report = {
        "id": obj.id,
        "category": obj.category,
        "split": split,
        "key": key,
        "parts": [asdict(p) for p in parts],
        "left_out": [{"joint": joint, "reason": reason} for joint, reason in left_out],
        "notes": obj.notes,
        "groups": groups,
        "handles": [asdict(h) for h in handles],
        "scenes": len(bank),
        "merged_scenes": [asdict(s) for s in merged],
        "seconds": round(time.process_time() - start, 3),  # of one core
    }
    with atomic_directory(out / obj.id) as part:
        mjcf.write(part)
        converted.save(part)
        bank.save(part / "scenes.npz")
        save_png(part / "picture.png", render_preview(converted))
        write_json(part / "report.json", report)


def _write_banks(
    out: Path,
    current: dict[str, str],
    failed: list[dict[str, str]],
    config: ConvertConfig,
    jobs: int,
    made: dict[str, Any],
) -> dict[str, Any]:
    """Write what describes the current objects together, as far as `made` (returned by an earlier call) does not fit.

    Views with at least as many points as the config has are left alone. Returns what was made, for convert.json.
    """
    names, key = sorted(current), hash_of(sorted(current.items()))
    files = ("splits.json", "scenes.npz", "contact_sheet.png")
    has_scenes = made.get("key") == key and all((out / file).is_file() for file in files)
    views, wanted = made.get("views", {}), views_key(current, config)
    has_views = views.get("key") == wanted and views.get("points", 0) >= config.view.points
    rendered = None
    if not (has_views and (out / "views.npz").is_file()):
        objects = [ConvertedObject.load(out / name) for name in names]
        rendered, without = render_views(objects, config.variants, config.seed, config.view, jobs)
        views = {"key": wanted, "points": config.view.points, "without": [reason for _, reason in without]}
    if not has_scenes:
        bank = SceneBank.concatenate([SceneBank.load(out / name / "scenes.npz") for name in names])
        pictures = [read_png(out / name / "picture.png") for name in names]
        if rendered is not None:  # interrupted from here on, the folder lacks views, and does not have those of others
            (out / "views.npz").unlink(missing_ok=True)
        write_json(out / "splits.json", _split_table([read_json(out / name / "report.json") for name in names]))
        bank.save(out / "scenes.npz")
        save_png(out / "contact_sheet.png", contact_sheet(pictures, max(1, round(len(pictures) ** 0.5 / 2))))
    if rendered is not None:
        rendered.save(out / "views.npz")
    report = hash_of([key, failed, views["without"]])
    if made.get("report") != report or not (out / "report.html").is_file():
        reports = [read_json(out / name / "report.json") for name in names]
        write_text(out / "report.html", html_report(reports, failed, views["without"]))
    return {"key": key, "views": views, "report": report}


def _split_table(reports: Sequence[dict[str, Any]]) -> dict[str, dict[str, list[str]]]:
    """splits.json: ids by split and category."""
    table: dict[str, dict[str, list[str]]] = {split: {} for split in SPLITS}
    for report in reports:
        table[report["split"]].setdefault(report["category"], []).append(report["id"])
    return table
