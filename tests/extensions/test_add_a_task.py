"""A new task in one file: drawers that stand open are pushed further open, from the inside of their fronts."""

import dataclasses

import jax
import numpy as np
import pytest

from vatmart_jax.data.banks import SLIDE
from vatmart_jax.envs import EnvConfig, Task, make_env, register_task
from vatmart_jax.envs.scripted_policy import run_scripted_policy
from vatmart_jax.envs.task import unregister_task

PUSH_OPEN = Task(
    name="push-open-drawer", part_kind="drawer", joint_type=SLIDE, direction=1, interaction="push",
    goal_range=(0.05, 0.15), relabel_range=0.1,
)  # fmt: skip


@pytest.fixture(autouse=True)
def registered():
    register_task(PUSH_OPEN)
    yield
    unregister_task(PUSH_OPEN.name)


def test_drawers_are_pushed_open_from_inside(cabinets):
    bank, views = cabinets
    # Cameras behind the cabinets' fronts: contacts on the back of the panel, and drawers that stand half open.
    inside = dataclasses.replace(
        views, contacts=views.contacts + np.float32([0.0201, 0, 0]), contact_normals=-views.contact_normals,
        contact_handle=np.zeros_like(views.contact_handle), direction=-views.direction,
    )  # fmt: skip
    env = make_env(bank, inside, "push-open-drawer", config=EnvConfig(num_envs=32))
    final = run_scripted_policy(env, env.sample(jax.random.key(0), 32), jax.random.key(1))
    free = np.asarray(final.valid)
    assert free.mean() > 0.3 and np.asarray(final.success)[free].mean() > 0.7
