"""What is up to date: hashes of all that a converted object, and the views of a folder, depend on.

Bump CONVERSION_VERSION whenever a change of the code gives another model.xml, object.npz, scenes.npz or report.json for
the same files and flags (readers, part detection, decomposition, Scenes, MJCF): every object is converted again. Bump
VIEWS_VERSION whenever a change gives other views for the same converted objects (`render_views`, the camera, the part
kinds' goal ranges): views are rendered again, nothing is converted. A change that moves, renames or speeds up code
bumps neither. Versions of the libraries that results depend on are part of the keys by themselves.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, replace
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from conversion.config import ConvertConfig
from conversion.readers.base import ObjectReader

CONVERSION_VERSION = 2
VIEWS_VERSION = 2
_LIBRARIES = ("numpy", "scipy", "trimesh", "coacd", "mujoco")


@cache
def library_versions() -> dict[str, str]:
    """Of the libraries that results depend on; "" where one is not installed."""
    return {name: _version(name) for name in _LIBRARIES}


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return ""


def object_key(folder: Path, reader: ObjectReader, config: ConvertConfig, split: str | None) -> str:
    """Of one converted object: its files, the flags that change it, the versions."""
    settings = asdict(config)
    del settings["view"], settings["time_limit"]
    digest = hashlib.sha256()
    parts = [CONVERSION_VERSION, reader.name, settings, split, library_versions()]
    digest.update(json.dumps(parts, sort_keys=True).encode())
    for path in sorted(reader.files(folder, config.read)):
        if path.is_file():
            digest.update(str(path.relative_to(folder)).encode())
            # A link out of the folder is refused later and not read now.
            if path.resolve().is_relative_to(folder.resolve()):
                digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:32]


def views_key(objects: Mapping[str, str], config: ConvertConfig) -> str:
    """Of the views of these objects (id -> key), whatever their number of points: fewer are the first of more."""
    view = replace(config.view, points=0)
    return hash_of([VIEWS_VERSION, asdict(view), config.variants, config.seed, sorted(objects.items())])


def hash_of(value: Any) -> str:
    """Of what JSON can write."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
