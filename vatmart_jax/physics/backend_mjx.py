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
from mujoco.mjx._src import math, mesh  # no public names for these; mujoco-mjx is pinned to one minor version

from vatmart_jax import rotations as rot
from vatmart_jax.data.banks import SceneBank
from vatmart_jax.physics.config import PhysicsConfig
from vatmart_jax.physics.gripper import GRIPPERS
from vatmart_jax.physics.scene_model import Template, scene_model, template
from vatmart_jax.physics.types import PhysicsState, bits_of, recorded_rollout

# MJX tests every pair of geoms that it is given, near or not. So each of the gripper's boxes gets its own nearest
# slots, chosen anew every few steps: this many of the static object and of the part. For hulls, fewer: each slot is a
# kernel of its own to compile.
NEAR = {"box": (2, 3), "hull": (1, 2)}
RENEW = 4
# Its Newton solver runs for the slowest of the batch, and its line search always to the end.
ITERATIONS, LS_ITERATIONS = 5, 5


class CollisionSlots(NamedTuple):
    """What fills N slots of a body, and oriented boxes around it; body frame."""

    pos: jax.Array  # [..., N, 3] of the geom
    quat: jax.Array  # [..., N, 4]
    size: jax.Array  # [..., N, 3]
    mesh: jax.Array  # [..., N] int32, -1 in a box bank
    centre: jax.Array  # [..., N, 3] of the oriented box
    half: jax.Array  # [..., N, 3]


class SceneRow(NamedTuple):
    """A Scene as leaves of an mjx.Model."""

    fields: dict[str, jax.Array]  # of bodies, joints and degrees of freedom
    static: CollisionSlots
    part: CollisionSlots


class MjxPhysics:
    """The trials of CPhysics in float32, with the contacts that MJX finds. `vmap` adds simulations to the batch."""

    def __init__(self, bank: SceneBank, config: PhysicsConfig):
        self.config, self.gripper = config, GRIPPERS.get(config.gripper)
        geoms = self.gripper.geoms
        full = template(bank, config)
        static, part = (np.flatnonzero(full.model.geom_bodyid == full.model.body(b).id) for b in ("object", "part"))
        self._near = [min(n, len(slots)) for n, slots in zip(NEAR[bank.collision], (static, part), strict=True)]
        counts = [len(geoms) * n for n in self._near]
        model = scene_model(bank, 0, config, (counts[0], counts[1]))
        model.opt.iterations, model.opt.ls_iterations = ITERATIONS, LS_ITERATIONS
        boxes = [model.geom(name).id for name in geoms]
        near, own = sum(counts), np.concatenate([np.repeat(np.arange(len(geoms)), n) for n in self._near])
        model.geom_contype[:near], model.geom_conaffinity[:near] = 0, 1 << own
        model.geom_contype[boxes], model.geom_conaffinity[boxes] = 1 << np.arange(len(geoms)), 0
        self._meshes = _convex_meshes(full.model) if bank.collision == "hull" else None
        if self._meshes is not None:
            model.geom_dataid[:near] = model.mesh("parked").id
        self._model = mjx.put_model(model, impl="jax")
        if self._meshes is not None:
            # Every mesh id is a kernel of its own, whose shape is a leaf: one for each slot.
            self._model = self._model.replace(geom_dataid=np.concatenate([np.arange(near), model.geom_dataid[near:]]))
        self._data = mjx.make_data(self._model)
        self._boxes, self._part, self._base = np.array(boxes), model.body("part").id, model.body("gripper_base").id
        fields = {
            name: jnp.asarray(value, jnp.float32)
            for name, value in full.fields.items()
            if not name.startswith("geom_") and isinstance(getattr(self._model, name), jax.Array)
        }
        self._scenes = SceneRow(fields, _slots(full, static), _slots(full, part))

    def reset(self, scene: jax.Array, gripper_pose: jax.Array, qpos: jax.Array) -> PhysicsState:
        def contact(row, pose, qpos):
            data = self._data.replace(qpos=qpos)
            model = self._with_slots(self._placed(row, pose), self._nearest(row, pose, qpos))
            return _touches(mjx.collision(model, mjx.kinematics(model, data)))

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
            after = jax.vmap(self._step)(rows, pose, near, (qpos, qvel, warmstart), ctrl)
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

    def _step(self, row: SceneRow, pose, near: CollisionSlots, state, ctrl):
        """One step of one simulation from its qpos, qvel and qacc_warmstart: the new ones, and whether it touches."""
        qpos, qvel, warmstart = state
        data = self._data.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart, ctrl=ctrl)
        model = self._with_slots(self._placed(row, pose), near)
        data = self._forward(model, data)
        # An actuator at its force limit has no damping to integrate implicitly: C leaves it out, MJX 3.17 does not.
        free = jnp.abs(data.actuator_force) < model.actuator_forcerange[:, 1]
        data = mjx.implicit(model.replace(actuator_biasprm=model.actuator_biasprm * free[:, None]), data)
        return data.qpos, data.qvel, data.qacc_warmstart, _touches(data)

    def _forward(self, model: mjx.Model, data: mjx.Data) -> mjx.Data:
        """`mjx.forward`, with the contacts put right in its middle."""
        for stage in (mjx.kinematics, mjx.com_pos, mjx.crb, mjx.factor_m, mjx.collision):
            data = stage(model, data)
        data = _without_copies(data if self._meshes is not None else _with_edges(model, data))
        solve = (mjx.fwd_velocity, mjx.fwd_actuation, mjx.fwd_acceleration, mjx.solve)
        for stage in (mjx.make_constraint, mjx.transmission, *solve):
            data = stage(model, data)
        return data

    def _placed(self, row: SceneRow, pose: jax.Array) -> mjx.Model:
        """The model of one simulation: its Scene, but for the geoms, and its gripper's start pose."""
        model = self._model.replace(**row.fields)
        # In MJX the children of a mocap body do not follow mocap_pos (mujoco-mjx 3.17), but they do follow body_pos.
        return model.replace(
            body_pos=model.body_pos.at[self._base].set(pose[:3]),
            body_quat=model.body_quat.at[self._base].set(pose[3:]),
        )

    def _nearest(self, row: SceneRow, pose: jax.Array, qpos: jax.Array) -> CollisionSlots:
        """The slots nearest to each of the gripper's boxes: the static ones, then the part's."""
        model = self._placed(row, pose)
        at = mjx.kinematics(model, self._data.replace(qpos=qpos))
        boxes = at.geom_xpos[self._boxes], at.geom_xmat[self._boxes], model.geom_size[self._boxes]
        static = _nearest(row.static, (jnp.zeros(3), jnp.eye(3)), boxes, self._near[0])
        part = _nearest(row.part, (at.xpos[self._part], at.xmat[self._part]), boxes, self._near[1])
        return jax.tree.map(lambda *x: jnp.concatenate(x), static, part)

    def _with_slots(self, model: mjx.Model, near: CollisionSlots) -> mjx.Model:
        n = len(near.pos)
        model = model.replace(
            geom_pos=model.geom_pos.at[:n].set(near.pos),
            geom_quat=model.geom_quat.at[:n].set(near.quat),
            geom_size=model.geom_size.at[:n].set(near.size),
        )
        if self._meshes is None:
            return model
        shapes = jax.tree.map(lambda x: x[near.mesh], self._meshes)
        convex = tuple(jax.tree.map(lambda x, i=i: x[i], shapes) for i in range(n))
        return model.replace(_impl=model._impl.replace(mesh_convex=convex))


def _slots(full: Template, geoms: np.ndarray) -> CollisionSlots:
    fields = {name: value[:, geoms] for name, value in full.fields.items() if name.startswith("geom_")}
    box = fields["geom_dataid"] < 0
    centre, half = np.split(fields["geom_aabb"].reshape(*box.shape, 6), 2, -1)
    mat = np.asarray(rot.matrix_from_quat(jnp.asarray(fields["geom_quat"])))
    centre = fields["geom_pos"] + np.einsum("snij,snj->sni", mat, centre)
    arrays = (fields["geom_pos"], fields["geom_quat"], fields["geom_size"], fields["geom_dataid"], centre, half)
    return CollisionSlots(*(jnp.asarray(a, jnp.int32 if a.dtype.kind == "i" else jnp.float32) for a in arrays))


def _nearest(slots: CollisionSlots, body, boxes, n: int) -> CollisionSlots:
    """For each of K boxes the n nearest slots of a body, [K * n], by the widest gap along the six axes of both.

    body: position [3] and rotation [3, 3]. boxes: positions [K, 3], rotations [K, 3, 3] and half extents [K, 3].
    """
    (pos, mat), (box_pos, box_mat, box_half) = body, boxes
    apart = box_pos - (pos + slots.centre @ mat.T)[:, None]  # [N, K, 3]
    mats = mat @ rot.matrix_from_quat(slots.quat)
    turn = jnp.abs(jnp.einsum("nji,kjl->nkil", mats, box_mat))
    along = jnp.abs(jnp.einsum("nji,nkj->nki", mats, apart)) - slots.half[:, None]
    along -= jnp.einsum("nkil,kl->nki", turn, box_half)
    across = jnp.abs(jnp.einsum("kji,nkj->nki", box_mat, apart)) - box_half
    across -= jnp.einsum("nkil,ni->nkl", turn, slots.half)
    gap = jnp.maximum(along.max(-1), across.max(-1))
    chosen = jax.lax.top_k(-gap.T, n)[1].ravel()
    return jax.tree.map(lambda x: x[chosen], slots)


def _convex_meshes(model: mujoco.MjModel) -> mjx._src.types.ConvexMesh:
    """Every mesh of the model, padded to one size by repetition, which changes no contact; leaves [M, ...]."""
    meshes = [jax.tree.map(np.asarray, mesh.convex(model, i)) for i in range(model.nmesh)]

    def stacked(*arrays):
        size = np.max([a.shape for a in arrays], axis=0)
        return jnp.stack([np.pad(a, [(0, n - m) for n, m in zip(size, a.shape, strict=True)], "edge") for a in arrays])

    return jax.tree.map(stacked, *meshes)


def _with_edges(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Contacts of two boxes between edges wherever these overlap less than any face does, at their nearest points, as
    in C. MJX prefers faces that are nearly as good, and takes face points for edges: tilted grasps then differ.
    """
    contact = data._impl.contact
    pos, mat, half = (x[contact.geom] for x in (data.geom_xpos, data.geom_xmat, model.geom_size))  # [C, 2, ...]
    apart = pos[:, 1] - pos[:, 0]
    edges = jnp.cross(mat[:, 0, :, :, None], mat[:, 1, :, None, :], axis=1).reshape(-1, 3, 9)
    length = jnp.linalg.norm(edges, axis=1)
    axes = jnp.concatenate([mat[:, 0], mat[:, 1], edges / jnp.maximum(length, 1e-6)[:, None]], -1)  # [C, 3, 15]
    reach = jnp.einsum("cbji,cjk->cbik", mat, axes)  # of the axes in each box's frame
    along = jnp.einsum("cj,cjk->ck", apart, axes)
    depth = jnp.einsum("cbi,cbik->ck", half, jnp.abs(reach)) - jnp.abs(along)
    depth = depth.at[:, 6:].add(jnp.where(length < 1e-3, jnp.inf, 0.0))
    best = depth[:, 6:].argmin(-1)
    sign = jnp.sign(jnp.take_along_axis(along, 6 + best[:, None], 1))
    normal = sign * jnp.take_along_axis(axes, 6 + best[:, None, None], 2)[..., 0]
    edge = (contact.dist < 0) & (depth[:, 6:].min(-1) < depth[:, :6].min(-1) - 1e-6)

    picked = jnp.stack([jax.nn.one_hot(best // 3, 3), jax.nn.one_hot(best % 3, 3)], 1)  # [C, 2, 3] the edges' axes
    side = jnp.sign(jnp.einsum("cbji,cj->cbi", mat, normal)) * jnp.array([1.0, -1.0])[:, None]
    ends = pos + jnp.einsum("cbij,cbj->cbi", mat, side * half * (1 - picked))
    ways, limits = jnp.einsum("cbij,cbj->cbi", mat, picked), (half * picked).sum(-1)
    between, cosine = ends[:, 0] - ends[:, 1], (ways[:, 0] * ways[:, 1]).sum(-1)
    d, e = jnp.einsum("cbi,ci->bc", ways, between)
    sine = jnp.maximum(1 - cosine**2, 1e-6)
    shifts = jnp.clip(jnp.stack([cosine * e - d, e - cosine * d], -1) / sine[:, None], -limits, limits)
    nearest = ends + shifts[..., None] * ways
    contact = contact.replace(
        dist=jnp.where(edge, -depth[:, 6:].min(-1), contact.dist),
        pos=jnp.where(edge[:, None], nearest.mean(1), contact.pos),
        frame=jnp.where(edge[:, None, None], jax.vmap(math.make_frame)(normal), contact.frame),
    )
    return data.replace(_impl=data._impl.replace(contact=contact))


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
