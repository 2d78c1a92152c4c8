"""The environment: one trial is a start (view, contact point, hand orientation, goal) and four waypoints.

Pure functions on a batch of B trials with explicit keys:

    env = make_env(scenes, views, "push-door")
    state = env.reset(key)
    state = env.step(state, action)      # four times; action in [-1, 1]^6

The policy sees and acts in a joint-local frame (origin at the contact point, x along the part's motion in the
task's direction, z along the joint's axis), in which all doors look alike; trajectories are recorded in the object
frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from vatmart_jax import rotations as rot
from vatmart_jax.data.banks import SceneBank, SceneTable, ViewBank
from vatmart_jax.envs import start_sampler
from vatmart_jax.envs.observation import build_observation, observation_size
from vatmart_jax.envs.rewards import REWARD_TERMS, reward_terms, tracking_cost
from vatmart_jax.envs.start_sampler import StartTable
from vatmart_jax.envs.task import Task
from vatmart_jax.envs.types import EnvConfig, EnvState, TrialStart, ViewTable
from vatmart_jax.physics import Physics, PhysicsState
from vatmart_jax.physics.controller import waypoint_controls
from vatmart_jax.trajectory import WAYPOINTS

ACTION = 6  # move of the fingertips and rotation vector of the hand


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["scene_table", "view_table", "starts"],
    meta_fields=["task", "config", "physics"],
    drop_fields=["bank", "views"],
)
@dataclass(frozen=True, eq=False, kw_only=True)
class Env:
    """Trials of one task in the Scenes and views of a split. Made by `make_env` or `make_envs`; see there.

    A pytree: the tables are its leaves, so `jax.jit(Env.step)(env, state, action)` serves every environment with the
    same task, config, physics and shapes without another compilation. The host arrays are left out of it.
    """

    task: Task
    config: EnvConfig
    physics: Physics
    scene_table: SceneTable
    view_table: ViewTable
    starts: StartTable
    bank: SceneBank = None  # pyright: ignore[reportAssignmentType]  the Scenes, host arrays; None inside jitted functions
    views: ViewBank = None  # pyright: ignore[reportAssignmentType]  likewise; without the rows that pad view_table

    @property
    def action_size(self) -> int:
        return ACTION

    @property
    def observation_size(self) -> int:
        return observation_size(self.physics.gripper)

    @property
    def num_views(self) -> int:
        """Rows of the view table, those that pad it included."""
        return len(self.view_table.scene)

    def sample(self, key: jax.Array, n: int) -> TrialStart:
        """n random starts: category uniform, then object, Scene, view; goal; contact; approach; roll.

        Goals follow the paper's order given the view: goal uniform first, then a start that leaves room for it.
        Consumes the key.
        """
        kv, kt, ka = jax.random.split(key, 3)
        view = start_sampler.sample_views(kv, self.starts, n)
        return self.sample_approach(ka, view, self.sample_goal(kt, view), self.config.guided_fraction)

    def sample_approach(self, key: jax.Array, view: jax.Array, goal: jax.Array, guided_fraction: float) -> TrialStart:
        """Random contacts and hand orientations for views [B] and goals [B]; a share of them at candidate contacts.

        The rest have any contact, an approach within the cone about the inward normal, any roll. Consumes the key.
        """
        tables = {"table": self.starts, "views": self.view_table, "config": self.config}
        return start_sampler.sample_approaches(key, view, goal, guided_fraction, **tables)

    def sample_goal(self, key: jax.Array, view: jax.Array) -> jax.Array:
        """[B] goals for views [B], see `start_sampler.sample_goals`. Consumes the key."""
        return start_sampler.sample_goals(
            key, self._joint_range(view), self._remaining_range(view), self.task.goal_range
        )

    def reset(self, key: jax.Array, pool: TrialStart | None = None) -> EnvState:
        """A batch of random trials; some starts collide or fail to grasp and are done at once (`valid`).

        With a pool of known starts, trials begin at random ones of these, with new goals. Consumes the key.
        """
        if pool is None:
            return self.begin_trials(self.sample(key, self.config.num_envs))
        kp, kt = jax.random.split(key)
        chosen = jax.random.randint(kp, (self.config.num_envs,), 0, len(pool.view))
        start = jax.tree.map(lambda x: x[chosen], pool)
        return self.begin_trials(start.replace(goal=self.sample_goal(kt, start.view)))

    def begin_trials(self, start: TrialStart) -> EnvState:
        """Put the hand at its start poses and, where the task grasps, grasp."""
        return self._begin(start, None)[0]

    def is_collision_free(
        self, start: TrialStart, depth: float | None = None, displacement: jax.Array | None = None
    ) -> jax.Array:
        """[B] bool, the start poses touch nothing; or those with the fingertips `depth` past the contact points, or
        with part and hand moved on by `displacement` [B] in the task's direction."""
        physics = self._placed(start, -self.config.standoff if depth is None else depth, displacement)
        return ~(physics.in_contact | physics.diverged)

    def path_is_free(self, start: TrialStart) -> jax.Array:
        """[B] bool, the hand touches nothing while the largest goal carries part and hand along: no other open part
        and no frame is in the way."""
        longest = jnp.minimum(self.task.goal_range[1], self._remaining_range(start.view))
        shares = jnp.arange(1, WAYPOINTS + 1) / WAYPOINTS
        return jax.lax.map(lambda share: self.is_collision_free(start, displacement=share * longest), shares).all(0)

    def step(self, state: EnvState, action: jax.Array, *, terminate_on_failure: bool = True) -> EnvState:
        """One waypoint from an action [B, 6] in [-1, 1]: move of the fingertips and rotation vector of the hand, both
        in the joint-local frame.

        Finished trials are frozen. A trial is done when it succeeds, after four waypoints and, with
        `terminate_on_failure`, once it cannot succeed any more (grasp lost, unsound physics).
        """
        config = self.config
        move = rot.rotate(state.frame, action[:, :3] * config.max_translation)
        # The hand's rotation as seen in the joint-local frame, turned about that frame's axes.
        into = jnp.einsum("bji,bjk->bik", state.start.rotation, state.frame)
        turned = into.swapaxes(-1, -2) @ rot.matrix_from_euler(state.euler) @ into
        vector = rot.rotvec_from_matrix(rot.matrix_from_rotvec(action[:, 3:] * config.max_rotation) @ turned)
        angle = jnp.linalg.norm(vector, axis=-1, keepdims=True)
        vector = vector * jnp.minimum(1.0, config.max_total_rotation / jnp.maximum(angle, 1e-6))
        euler = rot.euler_from_matrix(into @ rot.matrix_from_rotvec(vector) @ into.swapaxes(-1, -2))
        residual = jnp.concatenate([move, euler - state.euler], -1)
        state, _ = self._advance(state, residual, None)
        lost = ~(state.valid & state.grasp_held) & terminate_on_failure
        return state.replace(done=state.done | state.success | lost)

    def execute(self, start: TrialStart, residuals: jax.Array) -> EnvState:
        """Whole trials, open loop, never stopped early: residuals [B, 4, 6] as `trajectory.pack_trajectory` has them.

        Starts in collision are failures and not simulated.
        """
        advance = lambda state, residual: self._advance(state, residual, None)
        return jax.lax.scan(advance, self.begin_trials(start), residuals.swapaxes(0, 1))[0]

    def record(self, start: TrialStart, residuals: jax.Array, every: int) -> tuple[EnvState, jax.Array]:
        """`execute`, and qpos [F, B, nq] at the start and after every `every` physics steps, a divisor of those of a
        waypoint; a grasp takes two waypoints of its own before the first one."""
        state, begun = self._begin(start, every)
        advance = lambda state, residual: self._advance(state, residual, every)
        state, frames = jax.lax.scan(advance, state, residuals.swapaxes(0, 1))
        return state, jnp.concatenate([*begun, frames.reshape(-1, *frames.shape[2:])])

    def tip(self, state: EnvState) -> jax.Array:
        """[B, 3] the point between the fingertips, object frame."""
        return self._tip(state.physics, state.start.rotation)

    def tracking_error(self, state: EnvState) -> jax.Array:
        """[B] distance of the hand from its command (unit lengths): that of the fingertips, and the angle times the
        hand's length. The controller is a spring, so this is about the force with which the hand pulls at the part."""
        gripper = self.physics.gripper
        sent = state.point - self.config.standoff * state.start.rotation[:, :, 2] + state.tip
        turn = state.euler - state.physics.qpos[:, gripper.hand_qpos][:, 3:]
        distance = jnp.linalg.norm(sent - self.tip(state), axis=-1)
        return distance + gripper.tip_offset * jnp.linalg.norm(turn, axis=-1)

    def tracking_cost(self, state: EnvState, penalty: float) -> jax.Array:
        """[B] penalty per unit length of `tracking_error`, where the task grasps."""
        return tracking_cost(self.tracking_error(state), self.task.grasps, penalty)

    def apply_joint_motion(self, state: EnvState, point: jax.Array, displacement: jax.Array) -> jax.Array:
        """[B, 3] points [B, 3] of the part after it has moved by `displacement` [B] in the task's direction."""
        scene = state.physics.scene
        axis, anchor = self._motion_axis(scene), self.scene_table.anchor[scene]
        return rot.apply_joint_motion(point, axis, anchor, displacement, self.task.is_hinge)

    def joints(self) -> tuple[jax.Array, jax.Array]:
        """[V, 3] the joint's axis in each view, signed so that positive motion is the task's, and a point on it."""
        scene = self.view_table.scene if self.views is None else self.view_table.scene[: len(self.views)]
        return self._motion_axis(scene), self.scene_table.anchor[scene]

    def _joint_range(self, view: jax.Array) -> jax.Array:
        return self.scene_table.joint_range[self.view_table.scene[view]]

    def _remaining_range(self, view: jax.Array) -> jax.Array:
        """[B] how far the parts of views [B] can move in the task's direction."""
        q = self.view_table.joint_pos[view]
        return self._joint_range(view) - q if self.task.direction > 0 else q

    def _opening(self, n: int) -> jax.Array:
        """[n] of each finger at the start pose."""
        return jnp.full((n,), self.physics.gripper.max_opening if self.task.grasps else 0.0)

    def _placed(self, start: TrialStart, depth: float, displacement: jax.Array | None = None) -> PhysicsState:
        """The hand with its tips `depth` past the contacts, closed to push and open to grasp; part and hand moved on
        together by `displacement` [B] in the task's direction, if given."""
        task, views, gripper = self.task, self.view_table, self.physics.gripper
        scene, rotation, q = views.scene[start.view], start.rotation, views.joint_pos[start.view]
        hand = gripper.hand_position(views.contacts[start.view, start.contact], rotation, depth)
        if displacement is not None:
            axis = self._motion_axis(scene)
            hand = rot.apply_joint_motion(hand, axis, self.scene_table.anchor[scene], displacement, task.is_hinge)
            if task.is_hinge:
                rotation = rot.matrix_from_rotvec(axis * displacement[:, None]) @ rotation
            q = q + task.direction * displacement
        pose = jnp.concatenate([hand, rot.quat_from_matrix(rotation)], -1)
        return self.physics.reset(scene, pose, gripper.rest_qpos(q, self._opening(len(scene))))

    def _begin(self, start: TrialStart, record_every: int | None) -> tuple[EnvState, list[Any]]:
        """The states at which trials begin, and the recorded qpos [f, B, nq] of every phase so far."""
        config, gripper = self.config, self.physics.gripper
        physics = self._placed(start, -config.standoff)
        frames = [] if record_every is None else [physics.qpos[None]]
        scene, n = physics.scene, len(start.view)
        q0, point = self.view_table.joint_pos[start.view], self.view_table.contacts[start.view, start.contact]
        up = start.rotation[:, :, 2]
        opening, closed = self._opening(n), jnp.zeros((n,))
        in_collision = physics.in_contact | physics.diverged
        zero = jnp.zeros((n, 3))
        ctrl = gripper.targets(zero, zero, start.rotation, opening)
        tip = zero
        held = ~in_collision
        if self.task.grasps:
            drive = partial(
                self._drive, start=start.rotation, euler=zero, active=~in_collision, record_every=record_every
            )
            advanced = (config.standoff + config.grasp_depth) * up
            physics, ctrl, advancing = drive(physics, ctrl, tip=advanced, opening=opening)
            # Close where the hand got to: pressed against a panel, fingers would stick to it and seem to hold it.
            tip = self._tip(physics, start.rotation) - (point - config.standoff * up)
            physics, ctrl, closing = drive(physics, ctrl, tip=tip, opening=closed)
            held = ~in_collision & self._holds(physics)
            frames += [] if record_every is None else [advancing, closing]
        valid = ~in_collision & held & ~physics.diverged
        nothing = jnp.zeros((n,))
        state = EnvState(
            start=start,
            point=point,
            frame=self._joint_frame(scene, point),
            q0=q0,
            physics=physics,
            ctrl=ctrl,
            tip=tip,
            euler=zero,
            waypoint=jnp.zeros((), jnp.int32),
            residuals=jnp.zeros((n, WAYPOINTS, 6)),
            progress=jnp.zeros((n, WAYPOINTS)),
            in_collision=in_collision,
            grasp_held=held,
            valid=valid,
            obs=jnp.zeros((n, self.observation_size)),
            reward=nothing,
            done=~valid,
            success=jnp.zeros((n,), bool),
            metrics=dict.fromkeys(REWARD_TERMS, nothing),
            info={"displacement": self._displacement(physics, q0), "tip_distance": nothing},
        )
        obs, distance = self._observe(state)
        return state.replace(obs=obs, info={**state.info, "tip_distance": distance}), frames

    def _advance(self, state: EnvState, residual: jax.Array, record_every: int | None) -> tuple[EnvState, Any]:
        """One waypoint, and its recorded qpos [f, B, nq]."""
        active = ~state.done
        residual = jnp.where(active[:, None], residual, 0.0)
        tip, euler = state.tip + residual[:, :3], state.euler + residual[:, 3:]
        physics, ctrl, frames = self._drive(
            state.physics, state.ctrl, tip=tip, euler=euler, start=state.start.rotation,
            opening=jnp.zeros(tip.shape[:1]), active=active, record_every=record_every,
        )  # fmt: skip
        before = state.displacement
        displacement = jnp.where(active, self._displacement(physics, state.q0), before)
        held = state.grasp_held & (self._holds(physics) | ~active) if self.task.grasps else state.grasp_held
        valid = state.valid & ~physics.diverged
        goal = state.start.goal
        success = valid & held & (jnp.abs(goal - displacement) <= self.config.tolerance * goal)
        waypoint = state.waypoint + 1
        state = state.replace(
            physics=physics,
            ctrl=jnp.where(active[:, None], ctrl, state.ctrl),
            tip=tip,
            euler=euler,
            waypoint=waypoint,
            residuals=state.residuals.at[:, state.waypoint].set(residual),
            progress=jnp.where(jnp.arange(WAYPOINTS) >= state.waypoint, displacement[:, None], state.progress),
            grasp_held=held,
            valid=valid,
            success=success,
            done=state.done | (waypoint >= WAYPOINTS),
            info={**state.info, "displacement": displacement},
        )
        obs, distance = self._observe(state)
        terms = reward_terms(goal, before, displacement, distance, success, self.config.reward)
        # Not 0.0: a weakly typed leaf that reset's state has not would compile every caller twice.
        metrics = {name: jnp.where(active, value, jnp.zeros_like(goal)) for name, value in terms.items()}
        state = state.replace(
            obs=obs,
            reward=sum(metrics.values()),
            metrics=metrics,
            info={**state.info, "tip_distance": distance},
        )
        return state, frames

    def _drive(
        self,
        physics: PhysicsState,
        ctrl: jax.Array,
        *,
        tip: jax.Array,
        euler: jax.Array,
        start: jax.Array,
        opening: jax.Array,
        active: jax.Array,
        record_every: int | None,
    ) -> tuple[PhysicsState, jax.Array, jax.Array | None]:
        """Physics after a waypoint, the targets [B, nu] that were driven to, and the recorded qpos [f, B, nq]."""
        target = self.physics.gripper.targets(tip, euler, start, opening)
        path = waypoint_controls(ctrl, target, self.physics.config)
        if record_every is None:
            return self.physics.rollout(physics, path, active), target, None
        physics, frames = self.physics.rollout(physics, path, active, record_every=record_every)
        return physics, target, frames

    def _holds(self, physics: PhysicsState) -> jax.Array:
        return physics.qpos[:, self.physics.gripper.finger_qpos].sum(-1) > self.config.grasp_min

    def _displacement(self, physics: PhysicsState, q0: jax.Array) -> jax.Array:
        return (physics.joint_pos - q0) * float(self.task.direction)

    def _motion_axis(self, scene: jax.Array) -> jax.Array:
        """[B, 3] the joint's axis, signed so that positive motion is the task's."""
        return self.scene_table.axis[scene] * float(self.task.direction)

    def _joint_frame(self, scene: jax.Array, point: jax.Array) -> jax.Array:
        axis = self._motion_axis(scene)
        if self.task.is_hinge:
            x = rot.normalize(jnp.cross(axis, point - self.scene_table.anchor[scene]))
            z = axis
        else:
            x = axis
            upright = jnp.array([0.0, 0.0, 1.0])
            side = jnp.where(jnp.abs(x[:, 2:]) > 0.9, jnp.array([0.0, 1.0, 0.0]), upright)
            z = rot.normalize(side - jnp.sum(side * x, -1, keepdims=True) * x)
        return jnp.stack([x, jnp.cross(z, x), z], -1)

    def _tip(self, physics: PhysicsState, start: jax.Array) -> jax.Array:
        gripper = self.physics.gripper
        hand_q = physics.qpos[:, gripper.hand_qpos]
        now = start @ rot.matrix_from_euler(hand_q[:, 3:])
        return physics.gripper_pose[:, :3] + rot.rotate(start, hand_q[:, :3]) + gripper.tip_offset * now[:, :, 2]

    def _observe(self, state: EnvState) -> tuple[jax.Array, jax.Array]:
        """The observation [B, 33], and the fingertips' distance to the contact [B]."""
        frame, start, physics, gripper = state.frame, state.start.rotation, state.physics, self.physics.gripper
        local = partial(rot.unrotate, frame)
        now = start @ rot.matrix_from_euler(physics.qpos[:, gripper.hand_qpos][:, 3:])
        tip = self.tip(state)
        contact = self.apply_joint_motion(state, state.point, state.displacement)
        anchor, axis = self.scene_table.anchor[physics.scene], self._motion_axis(physics.scene)
        nearest = anchor + jnp.sum((contact - anchor) * axis, -1, keepdims=True) * axis
        lever = contact - nearest
        length = jnp.linalg.norm(lever, axis=-1, keepdims=True)
        values = {
            "displacement": state.displacement[:, None],
            "goal": state.start.goal[:, None],
            "start_position": local(physics.gripper_pose[:, :3] - state.point),
            "start_rotation": rot.rot6d_from_matrix(jnp.einsum("bji,bjk->bik", frame, start)),
            "tip": local(tip - state.point),
            "rotation": rot.rotvec_from_matrix(jnp.einsum("bji,bjk,blk,blm->bim", frame, now, start, frame)),
            "fingers": physics.qpos[:, gripper.finger_qpos],
            "contact": local(contact - state.point),
            "axis": local(axis),
            "axis_point": local(nearest - state.point),
            "lever": length,
            "lever_direction": local(lever / jnp.maximum(length, 1e-6)),
        }
        return build_observation(gripper, values), jnp.linalg.norm(tip - contact, axis=-1)
