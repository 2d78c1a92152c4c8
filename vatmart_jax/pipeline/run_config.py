"""The resolved config of a run, as its folder and its priors carry it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from vatmart_jax.config import from_json
from vatmart_jax.pipeline import format_1
from vatmart_jax.pipeline.presets import Settings

FORMAT = 2


def settings_of(config: Mapping[str, Any], where: str = "config") -> Settings:
    """The settings of a run's config, in whatever format it was written. Raises ValueError for what does not fit."""
    found = config["settings"] if config.get("format", 1) == FORMAT else format_1.settings(config["settings"])
    return from_json(Settings, found, f"{where}: settings")
