"""Tasks: which part moves which way, by how much, and how the gripper does it; and their registry."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

from vatmart_jax.data.part_kinds import HINGE, PART_KINDS
from vatmart_jax.errors import UserError
from vatmart_jax.registry import Registry


@dataclass(frozen=True, kw_only=True)
class Task:
    """Move one part of an object by a goal. Goals are positive: rad (hinges) or unit lengths (slides)."""

    name: str
    part_kind: str  # a name of PART_KINDS: door, drawer, lid
    joint_type: int  # HINGE or SLIDE
    direction: int  # +1 opens, -1 closes
    interaction: Literal["push", "grasp"]  # with closed fingers; or open, advance, close, and then move
    goal_range: tuple[float, float]  # smallest and largest
    relabel_range: float  # goals of the scorer's shifted negatives are off by up to this much
    handle_approach: tuple[Literal["motion", "normal"], ...] = ("motion",)
    """grasp: how the hand comes to a handle, the first that fits: against the part's opening motion, or along the
    contact's inward normal"""

    def __post_init__(self):
        if self.direction not in (1, -1):
            raise ValueError(f"task {self.name}: direction {self.direction} is neither 1 (opens) nor -1 (closes)")
        low, high = self.goal_range
        if not 0 < low < high:
            raise ValueError(f"task {self.name}: goal_range {self.goal_range} is not (low, high) with 0 < low < high")

    @property
    def is_hinge(self) -> bool:
        return self.joint_type == HINGE

    @property
    def grasps(self) -> bool:
        return self.interaction == "grasp"

    @property
    def unit(self) -> str:
        """Of goals and displacements."""
        return "rad" if self.is_hinge else "unit lengths"

    @property
    def part(self) -> str:
        """The kind of part and its joint, for messages: "door (hinge)"."""
        return f"{self.part_kind} ({'hinge' if self.is_hinge else 'slide'})"

    def parse_goal(self, text: str) -> float:
        """A goal from `30deg`, `0.5rad` or a plain number in the task's unit. Raises UserError."""
        number, unit = text.strip(), ""
        for suffix in ("deg", "rad"):
            if number.endswith(suffix):
                number, unit = number.removesuffix(suffix), suffix
        try:
            value = float(number)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and value > 0) or (unit and not self.is_hinge):
            example = "30deg or 0.5rad" if self.is_hinge else "0.3 (unit lengths)"
            raise UserError(f"goal {text!r}: expected a number above 0 such as {example}, for task {self.name}")
        return math.radians(value) if unit == "deg" else value

    def format_goal(self, goal: float) -> str:
        """A goal as `parse_goal` reads it, to a degree or a hundredth of a unit length."""
        return f"{math.degrees(goal):.0f}deg" if self.is_hinge else f"{goal:.2f}"


_TASKS: Registry[Task] = Registry("task")


def register_task(task: Task) -> Task:
    """Make a task known by its name. Raises ValueError where the name is taken."""
    _TASKS.register(task.name, task)
    return task


def get_task(name: str) -> Task:
    """Raises UserError, which lists the known names, where there is none of this name."""
    return _TASKS.get(name)


class _TaskView(Mapping[str, Task]):
    """The registered tasks by name."""

    def __getitem__(self, name: str) -> Task:
        if name not in _TASKS.names():
            raise KeyError(name)
        return _TASKS.get(name)

    def __iter__(self) -> Iterator[str]:
        return iter(_TASKS.names())

    def __len__(self) -> int:
        return len(_TASKS.names())


TASKS: Mapping[str, Task] = _TaskView()

_VERBS: tuple[tuple[str, int, Literal["push", "grasp"]], ...] = (("push", -1, "push"), ("pull", 1, "grasp"))
for _kind in map(PART_KINDS.get, ("door", "drawer", "lid")):
    for _verb, _direction, _interaction in _VERBS:
        register_task(
            Task(
                name=f"{_verb}-{_kind.name}",
                part_kind=_kind.name,
                joint_type=_kind.joint_type,
                direction=_direction,
                interaction=_interaction,
                goal_range=_kind.goal_range,
                relabel_range=_kind.relabel_range,
                # A lid lies flat: handles on its front stick out across its motion.
                handle_approach=("motion", "normal") if _kind.name == "lid" else ("motion",),
            )
        )
