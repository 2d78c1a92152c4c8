"""The banks that conversion makes of generated objects hold what they held."""

from __future__ import annotations

import numpy as np
import pytest
from adapter import convert_generated
from record import held, summary


@pytest.fixture(scope="module")
def banks(tmp_path_factory) -> dict[str, dict[str, np.ndarray]]:
    return dict(zip(("scenes", "views"), convert_generated(tmp_path_factory.mktemp("golden")), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("bank", ["scenes", "views"])
def test_every_array_of_a_bank_is_what_it_was(banks, bank):
    found = {name: summary(array) for name, array in banks[bank].items()}
    golden = held(f"{bank}.json", found)
    assert list(found) == list(golden)
    for name, of_array in golden.items():
        # An array of halves may have any of them rounded the other way; their mean hardly notices.
        step = 1e-3 if of_array["type"] == "float16" else 2e-5
        assert found[name].keys() == of_array.keys(), name
        for key, value in of_array.items():
            loose = key in ("first", "min", "max")
            if key in ("shape", "type", "sha256"):
                assert found[name][key] == value, (name, key)
            else:
                assert found[name][key] == pytest.approx(value, rel=1e-5, abs=step if loose else 2e-5), (name, key)


def test_the_objects_have_doors_and_drawers_with_views_of_both(banks):
    scenes, views = banks["scenes"], banks["views"]
    assert set(scenes["joint_type"].tolist()) == {0, 1}
    assert set(scenes["joint_type"][views["scene"]].tolist()) == {0, 1}
