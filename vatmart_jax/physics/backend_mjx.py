# MuJoCo's compiled names are invisible to pyright.
# pyright: reportAttributeAccessIssue=false

"""Physics on any XLA device: MJX, vmapped over simulations of different Scenes."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx
from mujoco.mjx._src import mesh  # no public names for these; mujoco-mjx is pinned to one minor version

from vatmart_jax import rotations as rot
from vatmart_jax.data.banks import SceneBank
from vatmart_jax.physics import mjx_boxes, mjx_solver
from vatmart_jax.physics.config import PhysicsConfig
from vatmart_jax.physics.gripper import GRIPPERS
from vatmart_jax.physics.mjx_boxes import Boxes, Pairs
from vatmart_jax.physics.scene_model import Template, scene_model, template
from vatmart_jax.physics.types import PhysicsState, bits_of, recorded_rollout

# Every few steps each simulation chooses anew what the gripper may touch: of a box bank so many pairs of boxes,
PAIRS = 8
# of a hull bank the nearest hulls of each of the gripper's boxes: so many of what does not move and of the part. Fewer,
# for each is a kernel of its own to compile.
NEAR_HULLS = (1, 2)
RENEW = 4
ITERATIONS, LS_ITERATIONS = 5, 4


class CollisionSlots(NamedTuple):
    """What fills N slots of a body, and oriented boxes around it; body frame."""

    pos: jax.Array  # [..., N, 3] of the geom
    quat: jax.Array  # [..., N, 4]
    size: jax.Array  # [..., N, 3]
    mesh: jax.Array  # [..., N] int32, -1 in a box bank
    centre: jax.Array  # [..., N, 3] of the oriented box
    half: jax.Array  # [..., N, 3]

    @property
    def boxes(self) -> Boxes:
        return Boxes(self.centre, rot.matrix_from_quat(self.quat), self.half)


class SceneRow(NamedTuple):
    """A Scene as leaves of an mjx.Model."""

    fields: dict[str, jax.Array]  # of bodies, joints and degrees of freedom
    static: CollisionSlots
    part: CollisionSlots


class MjxPhysics:
    """The trials of CPhysics in float32, with the contacts that MJX finds. `vmap` adds simulations to the batch."""

    def __init__(self, bank: SceneBank, config: PhysicsConfig):
        self.config, self.gripper = config, GRIPPERS.get(config.gripper)
        full = template(bank, config)
        static, part = (np.flatnonzero(full.model.geom_bodyid == full.model.body(b).id) for b in ("object", "part"))
        boxes = bank.collision == "box"
        self._collision = _BoxCollision(bank, config) if boxes else _HullCollision(bank, config, full.model)
        self._model, self._data = self._collision.model, mjx.make_data(self._collision.model)
        self._base = full.model.body("gripper_base").id
        fields = {
            name: jnp.asarray(value, jnp.float32)
            for name, value in full.fields.items()
            if not name.startswith("geom_") and isinstance(getattr(self._model, name), jax.Array)
        }
        self._scenes = SceneRow(fields, _slots(full, static), _slots(full, part))

    def reset(self, scene: jax.Array, gripper_pose: jax.Array, qpos: jax.Array) -> PhysicsState:
        def contact(row, pose, qpos):
            model = self._placed(row, pose)
            data = mjx.kinematics(model, self._data.replace(qpos=qpos))
            return _touches(self._collision.find(model, data, self._collision.nearest(row, data)))

        scene, gripper_pose, qpos = jnp.asarray(scene), jnp.asarray(gripper_pose), jnp.asarray(qpos)
        sound = jnp.isfinite(qpos).all(-1) & jnp.isfinite(gripper_pose).all(-1)
        touches = jax.vmap(contact)(self._rows(scene), gripper_pose, qpos)
        zero = jnp.zeros_like(qpos)
        return PhysicsState(
            scene=scene, gripper_pose=gripper_pose, qpos=qpos, qvel=zero, in_contact=touches & sound, diverged=~sound,
            backend_state=bits_of(zero),
        )  # fmt: skip

    def rollout(
        self, state: PhysicsState, ctrl: jax.Array, active: jax.Array, *, record_every: int | None = None
    ) -> Any:
        if record_every is not None:
            return recorded_rollout(self, state, ctrl, active, record_every)
        rows, pose = self._rows(state.scene), state.gripper_pose
        nearest = jax.vmap(self._nearest)

        def step(carry, at):
            i, ctrl = at
            near, qpos, qvel, warmstart, _, sound = carry
            near = jax.lax.cond(i % RENEW == 0, lambda: nearest(rows, pose, qpos), lambda: near)
            after = self._step(rows, pose, near, (qpos, qvel, warmstart), ctrl)
            # NaN compares as false.
            sound &= (jnp.abs(jnp.concatenate(after[:3], -1)) < mujoco.mjMAXVAL).all(-1)
            return (near, *after, sound), None

        sound = jnp.isfinite(ctrl).all((-1, -2))
        warmstart = jax.lax.bitcast_convert_type(state.backend_state, jnp.float32)
        # Filled in by the first step; a call here would be compiled once more.
        near = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(nearest, rows, pose, state.qpos))
        begin = (near, state.qpos, state.qvel, warmstart, state.in_contact, sound)
        steps = jnp.arange(ctrl.shape[1]), jnp.asarray(ctrl).swapaxes(0, 1)
        (_, qpos, qvel, warmstart, touches, sound), _ = jax.lax.scan(step, begin, steps)
        runs = active & ~state.diverged
        kept = lambda new, old: jnp.where((runs & sound)[:, None], new, old)
        return state.replace(
            qpos=kept(qpos, state.qpos),
            qvel=kept(qvel, state.qvel),
            in_contact=jnp.where(runs & sound, touches, state.in_contact),
            diverged=state.diverged | (runs & ~sound),
            backend_state=kept(bits_of(warmstart), state.backend_state),
        )

    def _rows(self, scene: jax.Array) -> SceneRow:
        return jax.tree.map(lambda table: table[scene], self._scenes)

    def _step(self, rows: SceneRow, pose: jax.Array, near: Any, state: tuple[jax.Array, ...], ctrl: jax.Array):
        """One step of B simulations from their qpos, qvel and qacc_warmstart: the new ones, and which of them touch."""
        data = jax.vmap(self._unconstrained)(rows, pose, near, state, ctrl)
        found = data._impl
        problem = mjx_solver.Problem(found.M, data.qacc_smooth, found.efc_J, found.efc_D, found.efc_aref)
        qacc, force = mjx_solver.solve(problem, state[2], iterations=ITERATIONS, ls_iterations=LS_ITERATIONS)
        qpos, qvel = jax.vmap(self._integrate)(rows, pose, data, qacc, force)
        return qpos, qvel, qacc, jax.vmap(_touches)(data)

    def _unconstrained(self, row: SceneRow, pose: jax.Array, near: Any, state: tuple[jax.Array, ...], ctrl: jax.Array):
        """`mjx.forward` of one simulation up to its constraints, which are not solved yet."""
        qpos, qvel, warmstart = state
        data = self._data.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart, ctrl=ctrl)
        model = self._placed(row, pose)
        data = self._collision.find(model, mjx.kinematics(model, data), near)
        for stage in (
            mjx.com_pos, mjx.crb, mjx.factor_m, mjx.make_constraint, mjx.transmission, mjx.fwd_velocity,
            mjx.fwd_actuation, mjx.fwd_acceleration,
        ):  # fmt: skip
            data = stage(model, data)
        return data

    def _integrate(self, row: SceneRow, pose: jax.Array, data: mjx.Data, qacc: jax.Array, force: jax.Array):
        """qpos and qvel after the step."""
        model = self._placed(row, pose)
        # An actuator at its force limit has no damping to integrate implicitly: C leaves it out, MJX 3.17 does not.
        free = jnp.abs(data.actuator_force) < model.actuator_forcerange[:, 1]
        model = model.replace(actuator_biasprm=model.actuator_biasprm * free[:, None])
        data = mjx.implicit(model, data.replace(qacc=qacc, qfrc_constraint=force))
        return data.qpos, data.qvel

    def _placed(self, row: SceneRow, pose: jax.Array) -> mjx.Model:
        """The model of one simulation: its Scene, but for the geoms, and its gripper's start pose."""
        model = self._model.replace(**row.fields)
        # In MJX the children of a mocap body do not follow mocap_pos (mujoco-mjx 3.17), but they do follow body_pos.
        return model.replace(
            body_pos=model.body_pos.at[self._base].set(pose[:3]),
            body_quat=model.body_quat.at[self._base].set(pose[3:]),
        )

    def _nearest(self, row: SceneRow, pose: jax.Array, qpos: jax.Array) -> Any:
        data = mjx.kinematics(self._placed(row, pose), self._data.replace(qpos=qpos))
        return self._collision.nearest(row, data)


class _BoxCollision:
    """Of a box bank: a list of pairs, which differs from simulation to simulation."""

    def __init__(self, bank: SceneBank, config: PhysicsConfig):
        # One geom stands for all of a body: of a contact's geoms MJX reads the body alone.
        model = scene_model(bank, 0, config, (1, 1))
        self._bodies = np.array([model.geom(name).id for name in ("object_0", "part_0")])
        self._part = model.body("part").id
        self._gripper = np.array([model.geom(name).id for name in GRIPPERS.get(config.gripper).geoms])
        self.model = mjx.put_model(model, impl="jax")
        self._half = self.model.geom_size[self._gripper]
        # The friction and softness of every contact, for all geoms are alike.
        data = mjx.kinematics(self.model, mjx.make_data(self.model))
        self._contact = mjx.collision(self.model, data)._impl.contact

    def _boxes(self, data: mjx.Data) -> tuple[tuple[jax.Array, jax.Array], Boxes]:
        """The part's pose, and the gripper's boxes."""
        gripper = Boxes(data.geom_xpos[self._gripper], data.geom_xmat[self._gripper], self._half)
        return (data.xpos[self._part], data.xmat[self._part]), gripper

    def nearest(self, row: SceneRow, data: mjx.Data) -> Pairs:
        return mjx_boxes.nearest_pairs(row.static.boxes, row.part.boxes, *self._boxes(data), PAIRS)

    def find(self, model: mjx.Model, data: mjx.Data, near: Any) -> mjx.Data:
        """With the contacts of near, which are Pairs."""
        del model
        found = mjx_boxes.contacts(near, *self._boxes(data), len(self._contact.dist))
        body = jnp.where(near.on_part[found.pair], self._bodies[1], self._bodies[0])
        geom = jnp.stack([body, jnp.asarray(self._gripper)[near.gripper[found.pair]]], -1)
        contact = self._contact.replace(
            dist=found.dist, pos=found.pos, frame=found.frame, geom=geom, geom1=geom[:, 0], geom2=geom[:, 1]
        )
        return data.replace(_impl=data._impl.replace(contact=contact))


class _HullCollision:
    """Of a hull bank: each of the gripper's boxes has slots of its own, which its nearest hulls fill."""

    def __init__(self, bank: SceneBank, config: PhysicsConfig, full: mujoco.MjModel):
        geoms = GRIPPERS.get(config.gripper).geoms
        slots = [int((full.geom_bodyid == full.body(b).id).sum()) for b in ("object", "part")]
        self._counts = [min(n, s) for n, s in zip(NEAR_HULLS, slots, strict=True)]
        model = scene_model(bank, 0, config, (len(geoms) * self._counts[0], len(geoms) * self._counts[1]))
        self._boxes, self._part = np.array([model.geom(name).id for name in geoms]), model.body("part").id
        own = np.concatenate([np.repeat(np.arange(len(geoms)), n) for n in self._counts])
        near = len(own)
        model.geom_contype[:near], model.geom_conaffinity[:near] = 0, 1 << own
        model.geom_contype[self._boxes], model.geom_conaffinity[self._boxes] = 1 << np.arange(len(geoms)), 0
        model.geom_dataid[:near] = model.mesh("parked").id
        self.model = mjx.put_model(model, impl="jax")
        # Every mesh id is a kernel of its own, whose shape is a leaf: one for each slot.
        self.model = self.model.replace(geom_dataid=np.concatenate([np.arange(near), model.geom_dataid[near:]]))
        self._meshes = _convex_meshes(full)

    def nearest(self, row: SceneRow, data: mjx.Data) -> CollisionSlots:
        """The slots nearest to each of the gripper's boxes: the static ones, then the part's."""
        half = self.model.geom_size[self._boxes]
        boxes = Boxes(data.geom_xpos[self._boxes], data.geom_xmat[self._boxes], half)
        part = row.part.boxes.moved(data.xpos[self._part], data.xmat[self._part])
        found = (
            _nearest_slots(row.static, row.static.boxes, boxes, self._counts[0]),
            _nearest_slots(row.part, part, boxes, self._counts[1]),
        )
        return jax.tree.map(lambda *x: jnp.concatenate(x), *found)

    def find(self, model: mjx.Model, data: mjx.Data, near: Any) -> mjx.Data:
        """With the contacts of near, which are CollisionSlots."""
        n = len(near.pos)
        model = model.replace(
            geom_pos=model.geom_pos.at[:n].set(near.pos),
            geom_quat=model.geom_quat.at[:n].set(near.quat),
            geom_size=model.geom_size.at[:n].set(near.size),
        )
        shapes = jax.tree.map(lambda x: x[near.mesh], self._meshes)
        convex = tuple(jax.tree.map(lambda x, i=i: x[i], shapes) for i in range(n))
        model = model.replace(_impl=model._impl.replace(mesh_convex=convex))
        return _without_copies(mjx.collision(model, mjx.kinematics(model, data)))


def _slots(full: Template, geoms: np.ndarray) -> CollisionSlots:
    fields = {name: value[:, geoms] for name, value in full.fields.items() if name.startswith("geom_")}
    box = fields["geom_dataid"] < 0
    centre, half = np.split(fields["geom_aabb"].reshape(*box.shape, 6), 2, -1)
    mat = np.asarray(rot.matrix_from_quat(jnp.asarray(fields["geom_quat"])))
    centre = fields["geom_pos"] + np.einsum("snij,snj->sni", mat, centre)
    arrays = (fields["geom_pos"], fields["geom_quat"], fields["geom_size"], fields["geom_dataid"], centre, half)
    return CollisionSlots(*(jnp.asarray(a, jnp.int32 if a.dtype.kind == "i" else jnp.float32) for a in arrays))


def _nearest_slots(slots: CollisionSlots, placed: Boxes, boxes: Boxes, count: int) -> CollisionSlots:
    """For each of K boxes the `count` nearest slots, [K * count], which `placed` has in the boxes' frame."""
    rows = jax.lax.top_k(-mjx_boxes.gaps(placed, boxes).T, count)[1].ravel()
    return jax.tree.map(lambda x: x[rows], slots)


def _convex_meshes(model: mujoco.MjModel) -> mjx._src.types.ConvexMesh:
    """Every mesh of the model, padded to one size by repetition, which changes no contact; leaves [M, ...]."""
    meshes = [jax.tree.map(np.asarray, mesh.convex(model, i)) for i in range(model.nmesh)]

    def stacked(*arrays):
        size = np.max([a.shape for a in arrays], axis=0)
        return jnp.stack([np.pad(a, [(0, n - m) for n, m in zip(size, a.shape, strict=True)], "edge") for a in arrays])

    return jax.tree.map(stacked, *meshes)


def _without_copies(data: mjx.Data) -> mjx.Data:
    """MJX fills the manifold of a pair up to four points with copies; each would be a spring of its own."""
    contact = data._impl.contact
    same = (contact.geom[:, None] == contact.geom).all(-1) & (jnp.abs(contact.pos[:, None] - contact.pos) < 1e-5).all(
        -1
    )
    first = same.argmax(-1) == jnp.arange(len(same))
    contact = contact.replace(dist=jnp.where(first, contact.dist, 1.0))
    return data.replace(_impl=data._impl.replace(contact=contact))


def _touches(data: mjx.Data) -> jax.Array:
    return (data._impl.contact.dist < 0).any()
