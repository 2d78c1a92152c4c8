"""The Scene template is read from the installed package."""

from __future__ import annotations

import mujoco

from mjcf_assets import scene_template


def test_the_template_compiles_and_has_a_part_and_a_hand():
    model = mujoco.MjSpec.from_string(scene_template()).compile()
    for body in ("object", "part", "hand"):
        assert model.body(body).id > 0
