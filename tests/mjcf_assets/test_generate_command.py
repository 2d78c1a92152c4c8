"""The flags of `vatmart generate`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mjcf_assets.command import Generate
from mjcf_assets.output_folder import GeneratorError
from vatmart_jax.cli.main import main


def test_categories_are_joined_by_commas(tmp_path, capsys):
    main(["generate", "--out", str(tmp_path), "--count", "3", "--categories", "Box,Safe", "--json"])
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["objects"] == 3
    made = [json.loads(p.read_text())["model_cat"] for p in sorted(tmp_path.glob("*/meta.json"))]
    assert made == ["Safe", "Box", "Box"]


def test_categories_do_not_go_with_stretched_copies(tmp_path):
    with pytest.raises(GeneratorError, match="--categories: "):
        Generate(out=tmp_path / "out", stretch=Path("objects"), categories="Box").run()
    assert not (tmp_path / "out").exists()
