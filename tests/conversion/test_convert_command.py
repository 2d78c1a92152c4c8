"""Flags of `vatmart convert` keep their names, whatever configuration they belong to."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from pathlib import Path

import pytest
import tyro

from conversion.command import Convert
from conversion.config import ConvertConfig, ViewConfig
from conversion.model import ObjectError
from vatmart_jax.pipeline.presets import PRESETS


def parsed(*words: str) -> Convert:
    return tyro.cli(Convert, args=words)


def test_every_field_is_a_flag_under_its_own_name():
    nested = [getattr(ConvertConfig(), f.name) for f in fields(ConvertConfig)]
    names = {f.name for config in nested if is_dataclass(config) for f in fields(config)}
    names |= {f.name for f in fields(ConvertConfig) if not is_dataclass(getattr(ConvertConfig(), f.name))}
    assert len(names) == 24
    flags = [
        f"--{name.replace('_', '-')}" for name in sorted(names - {"allow_missing", "textures", "continuous_range"})
    ]
    values = {"--collision": "box", "--decomposer": "coacd"}
    words = [word for flag in flags for word in (flag, values.get(flag, "7"))]
    config = parsed("src", "--out", "out", "--allow-missing", "--textures", "--continuous-range", *words).config
    assert config.read.allow_missing and config.read.textures and config.read.continuous_range
    assert (config.decompose.collision, config.decompose.part_budget, config.decompose.max_vertices) == ("box", 7, 7)
    assert (config.mjcf.density, config.view.points, config.variants, config.time_limit) == (7, 7, 7, 7)


def test_without_a_source_it_says_what_to_give():
    with pytest.raises(ObjectError, match="no source; give one or more object folders"):
        parsed("--out", "out").run()
    assert parsed("a", "b", "--out", "out").src == (Path("a"), Path("b"))


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_takes_the_views_of_a_default_conversion(preset):
    assert PRESETS[preset].perception.networks.encoder.n_points <= ViewConfig().points
