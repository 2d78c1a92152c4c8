"""Lids are hinges, and no doors: tasks of doors leave them alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vatmart_jax.data.part_kinds import HINGE, PART_KINDS, SLIDE
from vatmart_jax.envs.env import TASKS, Env
from vatmart_jax.errors import UserError


def test_doors_drawers_and_lids_are_known():
    kinds = [PART_KINDS.get(name) for name in ("door", "drawer", "lid")]
    assert [kind.joint_type for kind in kinds] == [HINGE, SLIDE, HINGE]
    for task in TASKS.values():
        kind = PART_KINDS.get(task.name.split("-")[1])
        assert (kind.joint_type, *kind.goal_range, kind.relabel_range) == pytest.approx(
            (task.joint_type, *task.goal_range, task.relabel_range)
        )


def test_a_lid_is_in_no_environment_of_doors(cabinets):
    bank, views = cabinets
    kinds = np.where(bank.object_id == "200", "lid", bank.part_kind)
    env = Env(replace(bank, part_kind=np.where(bank.joint_type == HINGE, kinds, "drawer")), views, TASKS["push-door"])
    assert set(env.bank.object_id) == {"100", "300"}
    with pytest.raises(UserError, match="the data has no door"):
        Env(replace(bank, part_kind=np.full(len(bank), "lid")), views, TASKS["push-door"])
