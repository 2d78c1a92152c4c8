"""The environment: one trial is a start (view, contact point, hand orientation, task) and four waypoints.

Pure functions on a batch of B trials with explicit keys:

    env = Env(scenes, views, TASKS["push-door"])
    state = env.reset(key)
    state = env.step(state, action)      # four times; action in [-1, 1]^6

The policy sees and acts in a joint-local frame (origin at the contact point, x along the part's motion in the
task's sense, z along the joint's axis), in which all doors look alike; trajectories are recorded in the object frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vatmart_jax import rotations as rot
from vatmart_jax.data.banks import HINGE, SLIDE, SceneBank, SceneTable, ViewBank
from vatmart_jax.envs.contact_candidates import candidate_contacts, canonical_grasps
from vatmart_jax.errors import UserError
from vatmart_jax.physics import PhysicsConfig, PhysicsState, make_physics
from vatmart_jax.physics.controller import hand_target, waypoint_controls
from vatmart_jax.physics.scene_model import FINGER_OPEN, FINGERS, HAND, PART, TIP
from vatmart_jax.trajectory import WAYPOINTS, pack_trajectory

OBSERVATION, ACTION = 33, 6
_FIT_DEPTH, _FIT_BATCH = 0.02, 1024  # unit lengths past the contact; poses tested at once
MIN_PUSHABLE = 4  # of a view's contacts; with fewer, it hardly shows where to push


@dataclass(frozen=True)
class Task:
    """What is asked of a part: open or close it by some amount."""

    name: str
    joint_type: int  # HINGE or SLIDE
    opening: bool  # pull, or push
    low: float  # smallest amount, rad or unit lengths
    high: float
    shift: float  # tasks of the scorer's negatives are off by up to this much


_DOOR, _DRAWER = (np.radians(10).item(), np.radians(70).item(), np.radians(45).item()), (0.1, 0.7, 0.45)
TASKS = {
    task.name: task
    for task in (
        Task("push-door", HINGE, False, *_DOOR),
        Task("pull-door", HINGE, True, *_DOOR),
        Task("push-drawer", SLIDE, False, *_DRAWER),
        Task("pull-drawer", SLIDE, True, *_DRAWER),
    )
}


@dataclass(frozen=True)
class EnvConfig:
    """Sizes and limits of a trial. Lengths in units, angles in rad."""

    num_envs: int = 256
    """trials that run at once"""
    max_translation: float = 0.35
    """largest move of the fingertips per waypoint and axis"""
    max_rotation: float = float(np.radians(45))
    """largest turn of the hand per waypoint, about each axis"""
    max_total_rotation: float = float(np.radians(80))
    """largest turn from the start pose: Euler angles stay regular"""
    standoff: float = 0.02
    """fingertips start this far from the contact point"""
    approach_cone: float = float(np.radians(30))
    """the hand approaches within this angle of the inward normal"""
    grasp_depth: float = 0.04
    """pulling: the open fingers advance this far past the contact point before they close"""
    grasp_min: float = 0.01
    """opening between closed fingers from which on something is held, as in the released code; at less, four in five
    pulls slip"""
    guided_fraction: float = 0.9
    """share of starts that are promising. Push: the contact's face points against the motion. Pull: a handle grasped
    from the front across its thin side, or an edge of the part straddled along the motion"""
    grasp_approach_cone: float = float(np.radians(20))
    """a promising grasp approaches within this angle of the straight one, and its roll is off by about half of it"""
    tolerance: float = 0.15
    """success: the part moved by the task within this share of it"""


@struct.dataclass
class TrialStart:
    """Where B trials begin."""

    view: jax.Array  # [B] int32, index into the environment's views
    contact: jax.Array  # [B] int32, index into that view's contacts
    goal: jax.Array  # [B] positive amount to move the part by, rad or unit lengths
    rotation: jax.Array  # [B, 3, 3] hand frame, object frame


@struct.dataclass
class EnvState:
    """B trials, K = 4 waypoints."""

    start: TrialStart
    point: jax.Array  # [B, 3] contact point at the start, object frame
    frame: jax.Array  # [B, 3, 3] joint-local frame, object frame
    q0: jax.Array  # [B] opening at the start
    physics: PhysicsState
    ctrl: jax.Array  # [B, 8] actuator targets in force
    tip: jax.Array  # [B, 3] commanded move of the fingertips since the start pose, object frame
    euler: jax.Array  # [B, 3] commanded hand angles, start frame
    waypoint: jax.Array  # [] int32, waypoints done
    residuals: jax.Array  # [B, K, 6] commanded residuals so far, zeros after the end
    progress: jax.Array  # [B, K] how far the part had moved in the task's sense after each waypoint
    in_collision: jax.Array  # [B] bool, the start pose touches the object
    grasp_held: jax.Array  # [B] bool, the part is held (always true when pushing)
    valid: jax.Array  # [B] bool, free start, grasp made if one is needed, physics sound
    obs: jax.Array  # [B, 33]
    reward: jax.Array  # [B]
    done: jax.Array  # [B] bool
    success: jax.Array  # [B] bool, now within tolerance (and still held)
    metrics: dict[str, jax.Array]  # reward terms, raw, [B] each
    info: dict[str, jax.Array]

    @property
    def displacement(self) -> jax.Array:
        """[B] how far the part has moved in the task's sense, rad or unit lengths."""
        return self.info["displacement"]

    @property
    def trajectory(self) -> jax.Array:
        """[B, 30] the commanded trajectory, zero padded."""
        return pack_trajectory(self.start.rotation, self.residuals)


class Env:
    """Trials of one task over the Scenes and views of a bank."""

    def __init__(
        self,
        bank: SceneBank,
        views: ViewBank,
        task: Task,
        impl: str = "c",
        config: EnvConfig | None = None,
        physics: PhysicsConfig | None = None,
    ):
        """Keeps the Scenes of the task's kind of part, and the views that leave room for the task and show where to do
        it: a door seen from the inside alone cannot be pushed shut, one that is flush and has no handle cannot be
        pulled. (The released code goes further: its trials are ones that a policy has solved from that view.)

        Raises UserError where nothing is left.
        """
        part_kind = "door" if task.joint_type == HINGE else "drawer"
        scenes = np.flatnonzero(bank.part_kind == part_kind)
        kind = "door (hinge)" if task.joint_type == HINGE else "drawer (slide)"
        if len(scenes) == 0:
            raise UserError(
                f"the data has no {kind}, which task {task.name} needs; give data with one or another --task"
            )
        views = views.of_scenes(scenes)
        bank = bank.select(scenes)
        remaining = bank.joint_range[views.scene] - views.joint_pos if task.opening else views.joint_pos
        views = views.select(((views.direction > 0) == task.opening) & (remaining >= task.low))
        candidates = candidate_contacts(bank, views, task.opening)
        nothing = UserError(
            f"the data has no view of a {kind} that can be moved by task {task.name}; convert with more --views"
        )
        if not candidates.any():
            raise nothing
        self.task, self.config, self.bank = task, config or EnvConfig(), bank
        self.physics = make_physics(bank, impl, physics)
        self._scenes = SceneTable.from_bank(bank)
        canonical = canonical_grasps(bank, views) if task.opening else ()
        self._show(views, candidates, canonical)
        if task.opening:
            candidates &= self._fit(candidates, *canonical)
            handle = candidates & views.contact_handle
            candidates = np.where(handle.any(1, keepdims=True), handle, candidates)
        shown = candidates.sum(1) >= (1 if task.opening else MIN_PUSHABLE)
        if not shown.any():
            raise nothing
        self._show(views.select(shown), candidates[shown], tuple(x[shown] for x in canonical))

    def _show(self, views: ViewBank, candidates: np.ndarray, canonical: tuple[np.ndarray, ...]) -> None:
        """Trials begin at these views from now on."""
        bank, self.views = self.bank, views
        self._view_scene = jnp.asarray(views.scene)
        self._view_q = jnp.asarray(views.joint_pos)
        self._view_cdf = jnp.asarray(np.cumsum(_balanced(bank, views)), jnp.float32)
        self._contacts = jnp.asarray(views.contacts)
        self._normals = jnp.asarray(views.contact_normals)
        self._promising = jnp.asarray(candidates)
        self._grasps = tuple(map(jnp.asarray, canonical))

    def _fit(self, chosen: np.ndarray, up: np.ndarray, closing_axis: np.ndarray) -> np.ndarray:
        """[V, C] bool, of the chosen ones: the open hand is free before the straight grasp and when it has advanced."""
        rows = np.argwhere(chosen)
        found = np.zeros_like(chosen)
        free = jax.jit(lambda start: self.is_collision_free(start) & self.is_collision_free(start, _FIT_DEPTH))
        for first in range(0, len(rows), _FIT_BATCH):
            # The last batch is filled up with the last row: one shape, one compilation.
            view, contact = rows[np.minimum(np.arange(first, first + _FIT_BATCH), len(rows) - 1)].T
            y, z = closing_axis[view, contact], up[view, contact]
            rotation = np.stack([np.cross(y, z), y, z], -1)
            start = TrialStart(jnp.asarray(view), jnp.asarray(contact), jnp.zeros(_FIT_BATCH), jnp.asarray(rotation))
            found[view, contact] = free(start)
        return found

    def sample(self, key: jax.Array, n: int) -> TrialStart:
        """n random starts: category uniform, then object, Scene, view; task; contact; approach; roll.

        Tasks follow the paper's order given the view: amount uniform first, then a start that leaves room for it.
        Consumes the key.
        """
        kv, kt, ka = jax.random.split(key, 3)
        view = jnp.searchsorted(self._view_cdf, jax.random.uniform(kv, (n,)) * self._view_cdf[-1])
        view = jnp.minimum(view, len(self.views) - 1).astype(jnp.int32)
        return self.sample_approach(ka, view, self.sample_goal(kt, view), self.config.guided_fraction)

    def sample_approach(self, key: jax.Array, view: jax.Array, task: jax.Array, guided_fraction: float) -> TrialStart:
        """Random contacts and hand orientations for views [B] and tasks [B]; a share of them promising ones.

        The rest have any contact, an approach within the cone about the inward normal, any roll. Consumes the key.
        """
        kc, kg, ka, kr, ks, ko = jax.random.split(key, 6)
        # A guided start weighs promising contacts so much that others are drawn only where a view has none.
        guided = jax.random.uniform(kg, (len(view), 1)) < guided_fraction
        contact = jax.random.categorical(kc, jnp.where(guided & self._promising[view], 20.0, 0.0), axis=-1)
        up = rot.sample_cone_direction(ka, -self._normals[view, contact], self.config.approach_cone)
        forward = jax.random.normal(kr, up.shape)
        if self._grasps:
            canonical, closing_axis = (x[view, contact] for x in self._grasps)
            aligned = guided & self._promising[view, contact][:, None]
            up = jnp.where(aligned, rot.sample_cone_direction(ks, canonical, self.config.grasp_approach_cone), up)
            # The fingers close along the hand's y; either finger may be on either side.
            k_side, k_off = jax.random.split(ko)
            side = jax.random.rademacher(k_side, (len(view), 1), up.dtype)
            off = jnp.tan(0.5 * self.config.grasp_approach_cone) * jax.random.normal(k_off, up.shape)
            forward = jnp.where(aligned, rot.normalize(side * jnp.cross(closing_axis, up)) + off, forward)
        return TrialStart(view, contact.astype(jnp.int32), task, rot.gripper_frame(up, forward))

    def sample_goal(self, key: jax.Array, view: jax.Array) -> jax.Array:
        """[B] amounts for views [B]: density of t given q when t is uniform and q then uniform where t fits."""
        width, high = (
            self._scenes.joint_range[self._view_scene[view]],
            jnp.minimum(self.task.high, self._remaining_range(view)),
        )
        # p(t | q) is proportional to 1 / (width - t) on [low, high]; inverted here.
        rest = jnp.maximum(width - self.task.low, 1e-3)
        share = jnp.maximum(width - high, 1e-3) / rest
        t = width - rest * share ** jax.random.uniform(key, view.shape)
        return jnp.clip(t, self.task.low, jnp.maximum(high, self.task.low))

    def reset(self, key: jax.Array, pool: TrialStart | None = None) -> EnvState:
        """A batch of random trials; some starts collide or fail to grasp and are done at once (`valid`).

        With a pool of known starts, trials begin at random ones of these, with new tasks. Consumes the key.
        """
        if pool is None:
            return self.begin_trials(self.sample(key, self.config.num_envs))
        kp, kt = jax.random.split(key)
        chosen = jax.random.randint(kp, (self.config.num_envs,), 0, len(pool.view))
        start = jax.tree.map(lambda x: x[chosen], pool)
        return self.begin_trials(start.replace(goal=self.sample_goal(kt, start.view)))

    def begin_trials(self, start: TrialStart) -> EnvState:
        """Put the hand at its start poses and, when pulling, grasp."""
        config, pulling = self.config, self.task.opening
        physics = self._placed(start, -config.standoff)
        scene, n = physics.scene, len(start.view)
        q0, point = self._view_q[start.view], self._contacts[start.view, start.contact]
        up = start.rotation[:, :, 2]
        fingers = jnp.full((n,), FINGER_OPEN if pulling else 0.0)
        in_collision = physics.in_contact | physics.diverged
        zero = jnp.zeros((n, 3))
        ctrl = hand_target(zero, zero, start.rotation, fingers)
        tip = zero
        held = ~in_collision
        if pulling:
            free = ~in_collision
            advanced = (config.standoff + config.grasp_depth) * up
            physics, ctrl = self._drive(physics, ctrl, advanced, zero, start.rotation, fingers, free)
            # Close where the hand got to: pressed against a panel, fingers would stick to it and seem to hold it.
            tip = self._tip(physics, start.rotation) - (point - config.standoff * up)
            physics, ctrl = self._drive(physics, ctrl, tip, zero, start.rotation, jnp.zeros((n,)), free)
            held = ~in_collision & self._holds(physics)
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
            obs=jnp.zeros((n, OBSERVATION)),
            reward=nothing,
            done=~valid,
            success=jnp.zeros((n,), bool),
            metrics=dict.fromkeys(("guidance", "distance", "far", "success"), nothing),
            info={"displacement": self._moved(physics, q0), "tip_distance": nothing},
        )
        obs, distance = self._observe(state)
        return state.replace(obs=obs, info={**state.info, "tip_distance": distance})

    def is_collision_free(
        self, start: TrialStart, depth: float | None = None, amount: jax.Array | None = None
    ) -> jax.Array:
        """[B] bool, the start poses touch nothing; or those with the fingertips `depth` past the contact points, or
        with part and hand moved on by `displacement` [B] in the task's sense."""
        physics = self._placed(start, -self.config.standoff if depth is None else depth, amount)
        return ~(physics.in_contact | physics.diverged)

    def path_is_free(self, start: TrialStart) -> jax.Array:
        """[B] bool, the hands would touch nothing on the way that the longest task carries part and hand along: no
        other open part and no frame is in the way."""
        longest = jnp.minimum(self.task.high, self._remaining_range(start.view))
        shares = jnp.arange(1, WAYPOINTS + 1) / WAYPOINTS
        return jax.lax.map(lambda share: self.is_collision_free(start, amount=share * longest), shares).all(0)

    def step(self, state: EnvState, action: jax.Array, terminate_on_failure: bool = True) -> EnvState:
        """One waypoint from an action [B, 6] in [-1, 1]: move of the fingertips and turn (rotation vector) of the
        hand, both in the joint-local frame. Trials that are done stay as they are; one is done when it succeeds,
        after four waypoints and, with `terminate_on_failure`, once it cannot succeed any more (lost grip,
        unsound physics).
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
        state = self._advance(state, residual)
        lost = ~(state.valid & state.grasp_held) & terminate_on_failure
        return state.replace(done=state.done | state.success | lost)

    def execute(self, start: TrialStart, residuals: jax.Array) -> EnvState:
        """Whole trials, open loop, never stopped early: residuals [B, 4, 6] as `geometry.pack_trajectory` has them.

        Starts in collision are failures and not simulated.
        """

        def waypoint(state, residual):
            return self._advance(state, residual), None

        return jax.lax.scan(waypoint, self.begin_trials(start), residuals.swapaxes(0, 1))[0]

    def _remaining_range(self, view: jax.Array) -> jax.Array:
        """[B] how far the parts of views [B] can move in the task's sense."""
        q = self._view_q[view]
        return self._scenes.joint_range[self._view_scene[view]] - q if self.task.opening else q

    def _placed(self, start: TrialStart, depth: float, amount: jax.Array | None = None) -> PhysicsState:
        """The hand with its tips `depth` past the contacts, closed to push and open to pull; part and hand as one moved
        on by `displacement` [B] in the task's sense, if given."""
        scene, rotation, q = self._view_scene[start.view], start.rotation, self._view_q[start.view]
        hand = self._contacts[start.view, start.contact] + (depth - TIP) * rotation[:, :, 2]
        if amount is not None:
            hinge, axis = self.task.joint_type == HINGE, self._motion_axis(scene)
            hand = rot.apply_joint_motion(hand, axis, self._scenes.anchor[scene], amount, hinge)
            rotation = rot.matrix_from_rotvec(axis * amount[:, None]) @ rotation if hinge else rotation
            q = q + amount if self.task.opening else q - amount
        n = len(scene)
        fingers = jnp.full((n, 2), FINGER_OPEN if self.task.opening else 0.0)
        qpos = jnp.concatenate([q[:, None], jnp.zeros((n, 6)), fingers], -1)
        return self.physics.reset(scene, jnp.concatenate([hand, rot.quat_from_matrix(rotation)], -1), qpos)

    def _advance(self, state: EnvState, residual: jax.Array) -> EnvState:
        active = ~state.done
        residual = jnp.where(active[:, None], residual, 0.0)
        tip, euler = state.tip + residual[:, :3], state.euler + residual[:, 3:]
        closed = jnp.zeros(tip.shape[:1])
        physics, ctrl = self._drive(state.physics, state.ctrl, tip, euler, state.start.rotation, closed, active)
        before = state.displacement
        moved = jnp.where(active, self._moved(physics, state.q0), before)
        held = state.grasp_held & (self._holds(physics) | ~active) if self.task.opening else state.grasp_held
        valid = state.valid & ~physics.diverged
        task = state.start.goal
        success = valid & held & (jnp.abs(task - moved) <= self.config.tolerance * task)
        waypoint = state.waypoint + 1
        state = state.replace(
            physics=physics,
            ctrl=jnp.where(active[:, None], ctrl, state.ctrl),
            tip=tip,
            euler=euler,
            waypoint=waypoint,
            residuals=state.residuals.at[:, state.waypoint].set(residual),
            progress=jnp.where(jnp.arange(WAYPOINTS) >= state.waypoint, moved[:, None], state.progress),
            grasp_held=held,
            valid=valid,
            success=success,
            done=state.done | (waypoint >= WAYPOINTS),
            info={**state.info, "displacement": moved},
        )
        obs, distance = self._observe(state)
        terms = reward_terms(task, before, moved, distance, success)
        # Not 0.0: a weakly typed leaf that reset's state has not would compile every caller twice.
        metrics = {name: jnp.where(active, value, jnp.zeros_like(task)) for name, value in terms.items()}
        return state.replace(
            obs=obs,
            reward=sum(metrics.values()),
            metrics=metrics,
            info={**state.info, "tip_distance": distance},
        )

    def _drive(self, physics, ctrl, tip, euler, rotation, fingers, active) -> tuple[PhysicsState, jax.Array]:
        target = hand_target(tip, euler, rotation, fingers)
        path = waypoint_controls(ctrl, target, self.physics.config)
        return self.physics.rollout(physics, path, active), target

    def _holds(self, physics: PhysicsState) -> jax.Array:
        return physics.qpos[:, FINGERS].sum(-1) > self.config.grasp_min

    def _moved(self, physics: PhysicsState, q0: jax.Array) -> jax.Array:
        return (physics.qpos[:, PART] - q0) * (1.0 if self.task.opening else -1.0)

    def _motion_axis(self, scene: jax.Array) -> jax.Array:
        """[B, 3] the joint's axis, signed so that positive motion is the task's."""
        return self._scenes.axis[scene] * (1.0 if self.task.opening else -1.0)

    def _joint_frame(self, scene: jax.Array, point: jax.Array) -> jax.Array:
        axis = self._motion_axis(scene)
        if self.task.joint_type == HINGE:
            x = rot.normalize(jnp.cross(axis, point - self._scenes.anchor[scene]))
            z = axis
        else:
            x = axis
            upright = jnp.array([0.0, 0.0, 1.0])
            side = jnp.where(jnp.abs(x[:, 2:]) > 0.9, jnp.array([0.0, 1.0, 0.0]), upright)
            z = rot.normalize(side - jnp.sum(side * x, -1, keepdims=True) * x)
        return jnp.stack([x, jnp.cross(z, x), z], -1)

    def apply_joint_motion(self, state: EnvState, point: jax.Array, amount: jax.Array) -> jax.Array:
        """[B, 3] where points [B, 3] of the part come to when it moves by `displacement` [B] in the task's sense."""
        scene = state.physics.scene
        axis, anchor = self._motion_axis(scene), self._scenes.anchor[scene]
        return rot.apply_joint_motion(point, axis, anchor, amount, self.task.joint_type == HINGE)

    def joints(self) -> tuple[jax.Array, jax.Array]:
        """[V, 3] the joint's axis in each view, signed so that positive motion is the task's, and a point on it."""
        return self._motion_axis(self._view_scene), self._scenes.anchor[self._view_scene]

    def tip(self, state: EnvState) -> jax.Array:
        """[B, 3] the point between the fingertips, object frame."""
        return self._tip(state.physics, state.start.rotation)

    def tracking_error(self, state: EnvState) -> jax.Array:
        """[B] how far the hand is from where it was sent (unit lengths): the fingertips, and the turn times the hand's
        length. The controller is a spring, so this is about the force with which the hand strains at the part."""
        sent = state.point - self.config.standoff * state.start.rotation[:, :, 2] + state.tip
        turn = state.euler - state.physics.qpos[:, HAND][:, 3:]
        return jnp.linalg.norm(sent - self.tip(state), axis=-1) + TIP * jnp.linalg.norm(turn, axis=-1)

    def _tip(self, physics: PhysicsState, start: jax.Array) -> jax.Array:
        hand_q = physics.qpos[:, HAND]
        now = start @ rot.matrix_from_euler(hand_q[:, 3:])
        return physics.gripper_pose[:, :3] + rot.rotate(start, hand_q[:, :3]) + TIP * now[:, :, 2]

    def _observe(self, state: EnvState) -> tuple[jax.Array, jax.Array]:
        """The paper's 33 numbers in the joint-local frame [B, 33], and the fingertips' distance to the contact [B]."""
        frame, start, physics = state.frame, state.start.rotation, state.physics
        local = lambda v: rot.unrotate(frame, v)
        task, moved = state.start.goal, state.displacement
        now = start @ rot.matrix_from_euler(physics.qpos[:, HAND][:, 3:])
        tip = self.tip(state)
        start_in_frame = jnp.einsum("bji,bjk->bik", frame, start)
        turn = rot.rotvec_from_matrix(jnp.einsum("bji,bjk,blk,blm->bim", frame, now, start, frame))
        contact = self.apply_joint_motion(state, state.point, moved)
        anchor, axis = self._scenes.anchor[physics.scene], self._motion_axis(physics.scene)
        from_anchor = contact - anchor
        nearest = anchor + jnp.sum(from_anchor * axis, -1, keepdims=True) * axis
        arm = contact - nearest
        length = jnp.linalg.norm(arm, axis=-1, keepdims=True)
        obs = jnp.concatenate(
            [
                moved[:, None],
                task[:, None],
                (task - moved)[:, None],
                local(physics.gripper_pose[:, :3] - state.point),
                rot.rot6d_from_matrix(start_in_frame),
                local(tip - state.point),
                turn,
                10 * physics.qpos[:, FINGERS],
                local(contact - state.point),
                local(axis),
                local(nearest - state.point),
                length,
                local(arm / jnp.maximum(length, 1e-6)),
            ],
            -1,
        )
        return obs, jnp.linalg.norm(tip - contact, axis=-1)


def reward_terms(task, before, after, distance, success) -> dict[str, jax.Array]:
    """The paper's extrinsic reward, term by term (section 4.1). All [B]; distance is from fingertips to contact."""
    return {
        "guidance": 300.0 * (jnp.abs(task - before) - jnp.abs(task - after)),
        "distance": -150.0 * distance,
        "far": -300.0 * (distance > 0.1),
        "success": 500.0 * success,
    }


def _balanced(bank: SceneBank, views: ViewBank) -> np.ndarray:
    """[V] probabilities: every category alike, then every object in it, Scene of it and view of that."""
    probability = np.ones(len(views))
    parents: list[tuple] = [()] * len(views)
    levels = (bank.category[views.scene], bank.object_id[views.scene], views.scene, np.arange(len(views)))
    for level in levels:
        keys = [(*parent, key) for parent, key in zip(parents, level.tolist(), strict=True)]
        children: dict[tuple, set] = {}
        for parent, key in zip(parents, keys, strict=True):
            children.setdefault(parent, set()).add(key)
        probability /= [len(children[parent]) for parent in parents]
        parents = keys
    return probability
