"""Environments from the banks: selection, feasibility, tables."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import jax.numpy as jnp
import numpy as np

from vatmart_jax.data.banks import SceneBank, SceneTable, ViewBank
from vatmart_jax.envs.contact_candidates import candidate_contacts
from vatmart_jax.envs.env import Env
from vatmart_jax.envs.feasibility import FeasibleContacts, feasible_contacts
from vatmart_jax.envs.start_sampler import StartTable, view_probabilities
from vatmart_jax.envs.task import Task, get_task
from vatmart_jax.envs.types import EnvConfig, ViewTable
from vatmart_jax.errors import UserError
from vatmart_jax.host_threads import allow_callbacks
from vatmart_jax.physics import Physics, PhysicsConfig, make_physics

_ALL = "all"


def make_env(
    scenes: SceneBank,
    views: ViewBank,
    task: Task | str,
    impl: str = "c",
    config: EnvConfig | None = None,
    physics: PhysicsConfig | None = None,
) -> Env:
    """The environment of a task in the Scenes of its part kind, and the views that leave range for the task and show
    where to do it: a door seen from the inside alone cannot be pushed shut, one that is flush and has no handle cannot
    be pulled. (The released code goes further: its trials are ones that a policy has solved from that view.)

    Raises UserError where nothing is left.
    """
    splits = {_ALL: np.arange(len(scenes))}
    options = {"impl": impl, "config": config, "physics": physics}
    return make_envs(scenes, views, splits, task, required=(_ALL,), **options)[_ALL]


def make_envs(
    scenes: SceneBank,
    views: ViewBank,
    splits: Mapping[str, np.ndarray],
    task: Task | str,
    *,
    impl: str = "c",
    config: EnvConfig | None = None,
    physics: PhysicsConfig | None = None,
    required: Collection[str] = (),
) -> dict[str, Env]:
    """Environments as of `make_env`, one per split that has something for the task, for programs compiled once.

    splits: name -> the split's Scenes (indices or boolean mask). All environments share one physics, over the union of
    their Scenes, and the shapes of their tables: views that fill a table up have no probability. Indices of Scenes,
    `env.bank` included, are into that union; `env.views` are the split's own.

    Raises UserError where a `required` split has nothing for the task.
    """
    allow_callbacks()
    task = get_task(task) if isinstance(task, str) else task
    config = config or EnvConfig()
    kind = (scenes.part_kind == task.part_kind) & (scenes.joint_type == task.joint_type)
    members = {
        name: np.isin(np.arange(len(scenes)), np.arange(len(scenes))[chosen]) & kind for name, chosen in splits.items()
    }
    for name in required:
        if not members[name].any():
            where = "" if name == _ALL else f"split {name}: "
            raise UserError(f"{where}the data has no {task.part}, which task {task.name} needs; give data that has one")
    union = np.flatnonzero(np.any([*members.values()], axis=0))
    if len(union) == 0:
        return {}
    bank, views = scenes.select(union), _with_range(scenes.select(union), views.of_scenes(union), task)
    members = {name: chosen[union] for name, chosen in members.items()}
    candidates = candidate_contacts(bank, views, task)
    rows: dict[str, np.ndarray] = {}
    if candidates.any():
        made = make_physics(bank, impl, physics)
        feasible = feasible_contacts(made, bank, views, task, candidates, config.standoff)
        rows = {name: np.flatnonzero(feasible.shown & chosen[views.scene]) for name, chosen in members.items()}
        rows = {name: found for name, found in rows.items() if len(found)}
    for name in required:
        if name not in rows:
            where = "" if name == _ALL else f"split {name}: "
            raise UserError(
                f"{where}the data has no view of a {task.part} that can be moved by task {task.name}; "
                "convert with more views"
            )
    length = max(map(len, rows.values()), default=0)
    return {
        name: _env(task, config, made, bank, views.select(found), feasible=feasible.select(found), length=length)
        for name, found in rows.items()
    }


def _with_range(bank: SceneBank, views: ViewBank, task: Task) -> ViewBank:
    """The views that were drawn for the task's direction and leave its smallest goal."""
    q = views.joint_pos
    remaining = bank.joint_range[views.scene] - q if task.direction > 0 else q
    return views.select((views.direction == task.direction) & (remaining >= task.goal_range[0]))


def _env(
    task: Task,
    config: EnvConfig,
    physics: Physics,
    bank: SceneBank,
    views: ViewBank,
    *,
    feasible: FeasibleContacts,
    length: int,
) -> Env:
    """An environment whose tables have `length` views; the last one fills them up, without probability."""
    rows = np.minimum(np.arange(length), len(views) - 1)
    table = lambda x: jnp.asarray(x[rows])
    return Env(
        task=task,
        config=config,
        physics=physics,
        scene_table=SceneTable.from_bank(bank),
        view_table=ViewTable(
            scene=table(views.scene),
            joint_pos=table(views.joint_pos),
            contacts=table(views.contacts),
            normals=table(views.contact_normals),
        ),
        starts=StartTable(
            view_cdf=jnp.asarray(np.cumsum(view_probabilities(bank, views))[rows], jnp.float32),
            candidate=table(feasible.contact),
            grasp=feasible.grasps and (table(feasible.grasps.approach), table(feasible.grasps.closing)),
        ),
        bank=bank,
        views=views,
    )
