"""Copies of articulated objects that are stretched along their own axes: new proportions, the same design.

A stretched object is an object as good as any: its closed geometry and its hinges are stretched, its parts stay rigid.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from mjcf_assets.generator import GeneratorError, make_folder
from vatmart_jax.atomic_io import whole_folder, write_text

LIMIT = 0.35  # of the logarithm of a length's factor
_ASKEW = 0.02  # sine of the angle by which a frame may be off its parent's axes
# Pictures are large and copies are for training, which sees no colours; the bounding box is another one.
_LEFT_BEHIND = shutil.ignore_patterns("*.urdf", "images", "bounding_box.json")


def stretched_copies(source: Path, out: Path, count: int, seed: int) -> list[str]:
    """Write `count` stretched copies of every training object of `source` and a splits.json into `out`.

    source: a folder of PartNet-Mobility objects with a splits.json. Returns the ids, which name the folders: the
    original's, an `x`, and the copy's number. A copy depends on the original, the seed and its number alone. Objects
    with frames askew to each other are left out: a stretched one would be no rigid body. Raises GeneratorError where
    an argument is out of range, or a folder cannot be used.
    """
    source, out = Path(source), Path(out)
    if not 1 <= count < 1000 or seed < 0:
        raise GeneratorError(f"--count {count} --seed {seed}: expected 1 <= count < 1000 and seed >= 0")
    try:
        training = json.loads((source / "splits.json").read_text())["train"]
        originals = {str(i): str(category) for category, ids in training.items() for i in ids}
    except (OSError, ValueError, KeyError, AttributeError, TypeError) as e:
        raise GeneratorError(f"{source}/splits.json: no readable list of training objects ({e}); write one") from e
    for name in originals:
        if Path(name).name != name or not (source / name).is_dir():
            raise GeneratorError(f"{source}/splits.json: {name!r} is no folder beside it; take it off the list")
    make_folder(out, {f"{name}x{k}" for name in originals for k in range(count)})
    table: dict[str, list[str]] = {}
    for original, category in originals.items():
        for k in range(count):
            draws = np.random.default_rng([seed, k, *original.encode()]).uniform(-LIMIT, LIMIT, 3)
            robot = _stretched(source / original / "mobility.urdf", np.exp(draws - draws.mean()))
            if robot is None:
                break
            name = f"{original}x{k}"
            with whole_folder(out / name) as part:
                shutil.copytree(source / original, part, symlinks=True, dirs_exist_ok=True, ignore=_LEFT_BEHIND)
                robot.write(part / "mobility.urdf")
            table.setdefault(category, []).append(name)
    write_text(out / "splits.json", json.dumps({"train": table}))
    return [name for names in table.values() for name in names]


def _stretched(urdf: Path, factors: np.ndarray) -> ElementTree.ElementTree[Any] | None:
    """The robot of a file with its lengths along the axes of its root frame times factors [3]; None where it is
    askew."""
    try:
        tree = ElementTree.parse(urdf)
        robot = tree.getroot()
        joints = robot.findall("joint")
        parent, child = ([_found(j, end).attrib["link"] for j in joints] for end in ("parent", "child"))
        links = {link.attrib["name"]: link for link in robot.findall("link")}
        own = {name: factors for name in links if name not in child}
        while len(own) < len(links):
            ready = [i for i in range(len(joints)) if parent[i] in own and child[i] not in own]
            for i in ready:
                turned = _stretch_origin(joints[i], own[parent[i]])
                if turned is None:
                    return None
                own[child[i]] = turned
                _stretch_axis(joints[i], turned)
            if not ready:
                raise ValueError("its joints form no tree")
        for name, link in links.items():
            for collision in link.findall("collision"):
                link.remove(collision)
            for visual in link.findall("visual"):
                mesh, turned = _found(visual, "geometry/mesh"), _stretch_origin(visual, own[name])
                if turned is None:
                    return None
                mesh.set("scale", _text(_numbers(mesh.get("scale", "1 1 1")) * turned))
    except (OSError, ElementTree.ParseError, KeyError, ValueError) as e:
        raise GeneratorError(f"{urdf}: cannot be stretched ({e}); repair it, or take it off splits.json") from e
    return tree


def _stretch_origin(element: ElementTree.Element, factors: np.ndarray) -> np.ndarray | None:
    """Stretch where an element is, in a frame whose lengths are times factors [3]; returns the factors [3] of its own
    frame, None where that is askew."""
    origin = element.find("origin")
    if origin is None:
        return factors
    origin.set("xyz", _text(_numbers(origin.get("xyz", "0 0 0")) * factors))
    turn = Rotation.from_euler("xyz", _numbers(origin.get("rpy", "0 0 0"))).as_matrix()
    axes = np.abs(turn) > 0.5
    return axes.T @ factors if np.abs(turn[~axes]).max() < _ASKEW else None


def _stretch_axis(joint: ElementTree.Element, factors: np.ndarray) -> None:
    """A hinge keeps its range; a slide's grows with its direction."""
    axis = joint.find("axis")
    if axis is None or joint.get("type") == "fixed":
        return
    direction = _numbers(axis.attrib["xyz"])
    stretched = direction * factors
    longer = np.linalg.norm(stretched) / np.linalg.norm(direction)
    axis.set("xyz", _text(stretched / longer))
    limit = joint.find("limit")
    if joint.get("type") == "prismatic" and limit is not None:
        for end in {"lower", "upper"} & set(limit.keys()):
            limit.set(end, _text(_numbers(limit.attrib[end]) * longer))


def _found(element: ElementTree.Element, path: str) -> ElementTree.Element:
    found = element.find(path)
    if found is None:
        raise ValueError(f"a <{element.tag}> has no {path}")
    return found


def _numbers(text: str) -> np.ndarray:
    return np.array([float(x) for x in text.split()])


def _text(numbers: np.ndarray) -> str:
    return " ".join(repr(float(x)) for x in numbers)
