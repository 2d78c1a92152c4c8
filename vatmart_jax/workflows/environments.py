"""The environments of a task, one per split of the data."""

from __future__ import annotations

from collections.abc import Collection

from vatmart_jax.data.cache import DataError
from vatmart_jax.data.dataset import SPLITS, Data
from vatmart_jax.envs import Env, Task, make_envs
from vatmart_jax.errors import UserError
from vatmart_jax.pipeline.settings import Settings


def split_environments(
    data: Data, task: Task, impl: str, settings: Settings, *, splits: Collection[str] = SPLITS,
    required: Collection[str] = (),
) -> tuple[dict[str, Env], dict[str, str]]:  # fmt: skip
    """The environment of each split that has something for the task, and why the others have none.

    The environments share one physics and the shapes of their tables, so programs compiled for one serve all. Raises
    DataError where a required split has nothing.
    """
    there = {split: scenes for split, scenes in data.splits().items() if split in splits}
    if missing := [split for split in required if split not in there]:
        raise DataError(f"{data.folder}: has no object of the split {missing[0]}; see splits.json")
    options = {"impl": impl, "config": settings.env, "physics": settings.physics}
    try:
        envs = make_envs(data.scenes, data.views, there, task, required=required, **options)
    except UserError as e:
        raise DataError(f"{data.folder}: {e}") from e
    left_out = {split: _reason(data, split, task, there) for split in splits if split not in envs}
    return {split: envs[split] for split in splits if split in envs}, left_out


def _reason(data: Data, split: str, task: Task, there: Collection[str]) -> str:
    """Why a split has no environment."""
    if split not in there:
        return f"{data.folder}: has no object of the split {split}; see splits.json"
    of_kind = (data.scenes.split == split) & (data.scenes.part_kind == task.part_kind)
    lacks = (
        f"view of a {task.part} that task {task.name} can move; convert with more views" if of_kind.any() else task.part
    )
    return f"{data.folder}: the split {split} has no {lacks}"
