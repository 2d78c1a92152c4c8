from __future__ import annotations

import math
from dataclasses import replace

import pytest

from vatmart_jax.envs import TASKS, get_task, register_task
from vatmart_jax.errors import UserError


def test_six_tasks_are_registered_and_unknown_names_list_them():
    assert set(TASKS) >= {f"{verb}-{kind}" for verb in ("push", "pull") for kind in ("door", "drawer", "lid")}
    assert "slide-door" not in TASKS and get_task("pull-lid") is TASKS["pull-lid"]
    with pytest.raises(UserError, match="task 'slide-door' is not known; use one of push-door, pull-door"):
        get_task("slide-door")
    with pytest.raises(ValueError, match="registered already"):
        register_task(TASKS["push-door"])


def test_a_pull_grasps_and_opens_and_a_push_closes():
    for name, task in TASKS.items():
        if name.startswith(("push-d", "pull-d", "push-lid", "pull-lid")) and len(name.split("-")) == 2:
            assert (task.grasps, task.direction) == ((True, 1) if name.startswith("pull") else (False, -1))
            assert task.unit == ("unit lengths" if task.part_kind == "drawer" else "rad")


@pytest.mark.parametrize(
    ("task", "text", "goal"),
    [("push-door", "30deg", math.radians(30)), ("pull-lid", "0.5rad", 0.5), ("pull-drawer", "0.3", 0.3)],
)
def test_goals_are_read_and_written_in_the_tasks_unit(task, text, goal):
    task = get_task(task)
    assert task.parse_goal(text) == pytest.approx(goal)
    assert task.parse_goal(task.format_goal(goal)) == pytest.approx(goal, abs=0.01)


@pytest.mark.parametrize(("task", "text"), [("pull-drawer", "30deg"), ("push-door", "-1"), ("push-lid", "wide")])
def test_goals_that_make_no_sense_are_refused(task, text):
    with pytest.raises(UserError, match=f"goal '{text}': expected a number above 0 such as .*, for task {task}"):
        get_task(task).parse_goal(text)


@pytest.mark.parametrize(("field", "value"), [("direction", 0), ("goal_range", (0.5, 0.2))])
def test_tasks_that_make_no_sense_are_refused(field, value):
    with pytest.raises(ValueError, match=f"task push-door: {field}"):
        replace(get_task("push-door"), **{field: value})
