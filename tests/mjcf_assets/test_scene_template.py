"""The Scene template and the grippers are read from the installed package."""

from __future__ import annotations

import mujoco
import pytest

from mjcf_assets import gripper_mjcf, scene_template


def test_the_template_compiles_and_has_a_part_and_a_base_for_the_gripper():
    model = mujoco.MjSpec.from_string(scene_template()).compile()
    for body in ("object", "part", "gripper_base"):
        assert model.body(body).id > 0


@pytest.mark.parametrize("file", ["panda_hand.xml", "robotiq_2f85.xml"])
def test_grippers_compile_alone(file):
    assert mujoco.MjSpec.from_string(gripper_mjcf(file)).compile().njnt == 2
