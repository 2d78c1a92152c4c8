# Kernels are Warp's language, which looks like Python; MuJoCo's compiled names are invisible to pyright.
# pyright: reportIndexIssue=false, reportArgumentType=false, reportOperatorIssue=false
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportAttributeAccessIssue=false
"""Physics on NVIDIA GPUs (and, slowly, on CPUs): MuJoCo Warp, T steps in one FFI call.

On a GPU a call is one CUDA graph, captured at its first use and replayed from then on; nothing waits for the host.
"""

from __future__ import annotations

import copy
import itertools
import weakref
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import mujoco_warp as mjw
import warp as wp
from jax.custom_batching import custom_vmap

from vatmart_jax.data.banks import SceneBank
from vatmart_jax.physics.config import PhysicsConfig
from vatmart_jax.physics.gripper import GRIPPERS
from vatmart_jax.physics.scene_model import SCENE_FIELDS, Template, template
from vatmart_jax.physics.types import PhysicsState, bits_of, recorded_rollout

# The others exist once per model in Warp, or not at all; Scenes do not differ in what Warp reads of them.
_FIELDS = tuple(f for f in SCENE_FIELDS if f not in ("geom_sameframe", "body_sameframe", "body_simple", "dof_M0"))

# Room for contacts per world, shared by all, and for constraint rows of each world (docs/physics.md).
_CONTACTS, _CONTACTS_AT_LEAST, _ROWS = 64, 1024, 256
_LOST = mjw.OverflowType.NEFC | mjw.OverflowType.BROADPHASE | mjw.OverflowType.NARROWPHASE | mjw.OverflowType.CCD


class WarpPhysics:
    """MuJoCo Warp in float32, one world per simulation. `vmap` adds worlds.

    Worlds of simulations that are not active or not sound rest, their hand far from the object: they cost little, and
    neither fill the contact buffer, which all share, nor hand on a number.
    """

    def __init__(self, bank: SceneBank, config: PhysicsConfig):
        # Warp logs to standard output, which is for results.
        wp.config.log_level = max(wp.config.log_level, wp.LOG_ERROR)
        self.config, self.gripper = config, GRIPPERS.get(config.gripper)
        self._template = template(bank, config)
        self._worlds: dict[int, _Worlds] = {}  # by number of simulations
        self._device = wp.device_from_jax(jnp.zeros(()).device)
        mode = wp.JaxCallableGraphMode.WARP_STAGED if self._device.is_cuda else wp.JaxCallableGraphMode.NONE
        self._contact_call = wp.jax_callable(_contact, num_outputs=2, graph_mode=mode)
        self._step_call = wp.jax_callable(_step, num_outputs=5, graph_mode=mode)
        self._contact = _flat_vmap(self._contact)
        self._step = _flat_vmap(self._step)

    def reset(self, scene: jax.Array, gripper_pose: jax.Array, qpos: jax.Array) -> PhysicsState:
        scene, pose, qpos = jnp.asarray(scene, jnp.int32), *(jnp.asarray(x, jnp.float32) for x in (gripper_pose, qpos))
        finite = jnp.isfinite(qpos).all(-1) & jnp.isfinite(pose).all(-1)
        contact, sound = self._contact(scene, pose, qpos, finite)
        rest = jnp.zeros_like(qpos)
        return PhysicsState(
            scene=scene, gripper_pose=pose, qpos=qpos, qvel=rest, in_contact=contact, diverged=~sound,
            backend_state=bits_of(rest),
        )  # fmt: skip

    def rollout(
        self, state: PhysicsState, ctrl: jax.Array, active: jax.Array, *, record_every: int | None = None
    ) -> Any:
        if record_every is not None:
            return recorded_rollout(self, state, ctrl, active, record_every)
        ctrl = jnp.asarray(ctrl, jnp.float32)
        diverged = state.diverged | (active & ~jnp.isfinite(ctrl).all((-2, -1)))
        active = active & ~diverged
        warmstart = jax.lax.bitcast_convert_type(state.backend_state, jnp.float32)
        qpos, qvel, warmstart, contact, sound = self._step(
            state.scene, state.gripper_pose, state.qpos, state.qvel, warmstart, ctrl, active
        )
        good = active & sound
        return state.replace(
            qpos=jnp.where(good[:, None], qpos, state.qpos),
            qvel=jnp.where(good[:, None], qvel, state.qvel),
            in_contact=jnp.where(good, contact, state.in_contact),
            diverged=diverged | (active & ~sound),
            backend_state=jnp.where(good[:, None], bits_of(warmstart), state.backend_state),
        )

    def _contact(self, scene, *rest):
        return tuple(self._contact_call(self._handle(len(scene)), scene, *rest))

    def _step(self, scene, *rest):
        n = len(scene)
        rows = dict.fromkeys(("qpos_out", "qvel_out", "warmstart_out"), (n, self.gripper.num_qpos))
        dims = rows | dict.fromkeys(("contact_out", "sound_out"), (n,))
        return tuple(self._step_call(self._handle(n), scene, *rest, output_dims=dims))

    def _handle(self, n: int) -> int:
        """The worlds for n simulations, made while JAX traces: during calls a CUDA graph may be in the making."""
        if n not in self._worlds:
            self._worlds[n] = _Worlds(self._template, n, self._device)
        return self._worlds[n].handle


class _Worlds:
    """A Model in which the Scene fields have a row per world, and the Data of n worlds."""

    def __init__(self, template: Template, n: int, device: wp.Device):
        model = copy.copy(template.model)
        # Warp has no midphase, and refuses the flag that turns it off.
        model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
        if not (model.geom_type == mujoco.mjtGeom.mjGEOM_MESH).any():
            # Then two boxes collide as they do in C, rather than as any two convex shapes.
            model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)
        self._fields = []  # (values of all Scenes, rows of the worlds), two-dimensional
        with wp.ScopedDevice(device):
            self.model = mjw.put_model(model, batch_sizes=dict.fromkeys(_FIELDS, n))
            self.model.opt.warn_overflow = 0  # what is lost counts as divergence instead
            self.data = mjw.make_data(model, n, naconmax=max(_CONTACTS * n, _CONTACTS_AT_LEAST), njmax=_ROWS)
            self.alive = wp.zeros(n, dtype=bool)
            for name in _FIELDS:
                rows = getattr(self.model, name)
                rows = rows.reshape((n, rows.size // n))
                values = template.fields[name]
                shape = (len(values), rows.shape[1], *getattr(rows.dtype, "_shape_", ()))
                self._fields.append((wp.array(values.reshape(shape), dtype=rows.dtype), rows))
        self.handle = next(_HANDLES)
        _WORLDS[self.handle] = self

    def load(self, scene, pose, qpos, active) -> None:
        """Simulations at rest."""
        data = self.data
        for values, rows in self._fields:
            wp.launch(_gather, rows.shape, [values, scene], [rows])
        placed = [data.mocap_pos, data.mocap_quat, data.qpos, self.alive]
        wp.launch(_place, data.nworld, [pose, qpos, active], placed)
        for value in (data.qvel, data.qacc_warmstart, data.overflow):
            value.zero_()

    def report(self, contact_out, sound_out) -> None:
        """Who touches the object, and whose numbers are good."""
        data = self.data
        contact_out.zero_()
        wp.launch(_flag_contacts, data.naconmax, [data.nacon, data.contact.worldid], [contact_out])
        counts = [data.nacon, data.ncollision, data.naconmax, data.overflow]
        wp.launch(_judge, data.nworld, [data.qpos, data.qvel, data.qacc_warmstart, self.alive, *counts], [sound_out])


# A call carries the number of its worlds as a constant.
_HANDLES = itertools.count()
_WORLDS: weakref.WeakValueDictionary[int, _Worlds] = weakref.WeakValueDictionary()


def _contact(
    handle: int,
    scene: wp.array[int],
    pose: wp.array2d[float],
    qpos: wp.array2d[float],
    active: wp.array[bool],
    contact_out: wp.array[bool],
    sound_out: wp.array[bool],
) -> None:
    worlds = _WORLDS[handle]
    worlds.load(scene, pose, qpos, active)
    mjw.kinematics(worlds.model, worlds.data)
    mjw.collision(worlds.model, worlds.data)
    worlds.report(contact_out, sound_out)


def _step(
    handle: int,
    scene: wp.array[int],
    pose: wp.array2d[float],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    warmstart: wp.array2d[float],
    ctrl: wp.array3d[float],
    active: wp.array[bool],
    qpos_out: wp.array2d[float],
    qvel_out: wp.array2d[float],
    warmstart_out: wp.array2d[float],
    contact_out: wp.array[bool],
    sound_out: wp.array[bool],
) -> None:
    worlds = _WORLDS[handle]
    data, state = worlds.data, (worlds.data.qpos, worlds.data.qvel, worlds.data.qacc_warmstart)
    worlds.load(scene, pose, qpos, active)
    wp.copy(data.qvel, qvel)
    wp.copy(data.qacc_warmstart, warmstart)
    for step in range(ctrl.shape[1]):
        wp.launch(_begin_step, data.nworld, [step, ctrl], [data.ctrl, worlds.alive, *state, data.mocap_pos])
        mjw.step(worlds.model, data)
    for out, value in zip((qpos_out, qvel_out, warmstart_out), state, strict=True):
        wp.copy(out, value)
    worlds.report(contact_out, sound_out)


@wp.kernel
def _gather(values: wp.array2d[Any], scene: wp.array[int], rows_out: wp.array2d[Any]):
    world, i = wp.tid()
    rows_out[world, i] = values[scene[world], i]


for _dtype in (int, float, wp.vec2, wp.vec3, wp.quat):
    wp.overload(_gather, [wp.array2d[_dtype], wp.array[int], wp.array2d[_dtype]])


@wp.func
def _away() -> wp.vec3:
    return wp.vec3(0.0, 0.0, 1000.0)


@wp.kernel
def _place(
    pose: wp.array2d[float],
    qpos: wp.array2d[float],
    active: wp.array[bool],
    mocap_pos_out: wp.array2d[wp.vec3],
    mocap_quat_out: wp.array2d[wp.quat],
    qpos_out: wp.array2d[float],
    alive_out: wp.array[bool],
):
    # Mocap bodies: 0 is the object, at the origin; 1 is the gripper's base.
    world = wp.tid()
    alive_out[world] = active[world]
    mocap_pos_out[world, 1] = _away()
    mocap_quat_out[world, 1] = wp.quat(1.0, 0.0, 0.0, 0.0)  # MuJoCo's order: w first
    for i in range(qpos.shape[1]):
        qpos_out[world, i] = 0.0
    if active[world]:
        mocap_pos_out[world, 1] = wp.vec3(pose[world, 0], pose[world, 1], pose[world, 2])
        mocap_quat_out[world, 1] = wp.quat(pose[world, 3], pose[world, 4], pose[world, 5], pose[world, 6])
        for i in range(qpos.shape[1]):
            qpos_out[world, i] = qpos[world, i]


@wp.func
def _good(x: float) -> bool:
    return wp.abs(x) <= 1e10  # beyond, MuJoCo calls a number bad; false for NaN


@wp.func
def _sound(qpos: wp.array2d[float], qvel: wp.array2d[float], qacc: wp.array2d[float], world: int) -> bool:
    sound = bool(True)  # noqa: UP018  (a variable, in Warp)
    for i in range(qpos.shape[1]):
        sound = sound and _good(qpos[world, i]) and _good(qvel[world, i]) and _good(qacc[world, i])
    return sound


@wp.kernel
def _begin_step(
    step: int,
    ctrl: wp.array3d[float],
    ctrl_out: wp.array2d[float],
    alive_out: wp.array[bool],
    qpos_out: wp.array2d[float],
    qvel_out: wp.array2d[float],
    qacc_out: wp.array2d[float],
    mocap_pos_out: wp.array2d[wp.vec3],
):
    world = wp.tid()
    if not _sound(qpos_out, qvel_out, qacc_out, world):
        alive_out[world] = False
        mocap_pos_out[world, 1] = _away()
    if alive_out[world]:
        for i in range(ctrl_out.shape[1]):
            ctrl_out[world, i] = ctrl[world, step, i]
    else:
        for i in range(qpos_out.shape[1]):
            qpos_out[world, i] = 0.0
            qvel_out[world, i] = 0.0
            qacc_out[world, i] = 0.0
        for i in range(ctrl_out.shape[1]):
            ctrl_out[world, i] = 0.0


@wp.kernel
def _judge(
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    qacc: wp.array2d[float],
    alive: wp.array[bool],
    contacts: wp.array[int],
    pairs: wp.array[int],
    capacity: int,
    overflow: wp.array[int],
    sound_out: wp.array[bool],
):
    world = wp.tid()
    # A full contact buffer does not tell whose contacts it lacks.
    lost = contacts[0] > capacity or pairs[0] > capacity or (overflow[world] & wp.static(int(_LOST))) != 0
    sound_out[world] = alive[world] and not lost and _sound(qpos, qvel, qacc, world)


@wp.kernel
def _flag_contacts(contacts: wp.array[int], contact_world: wp.array[int], contact_out: wp.array[bool]):
    i = wp.tid()
    if i < contacts[0]:
        contact_out[contact_world[i]] = True


def _flat_vmap(call):
    """`vmap` of a function of arrays with a leading batch dimension makes that dimension longer."""
    flat = custom_vmap(call)

    @flat.def_vmap
    def _(size, batched, *args):
        args = (a if b else jnp.broadcast_to(a, (size, *a.shape)) for a, b in zip(args, batched, strict=True))
        out = flat(*(a.reshape(-1, *a.shape[2:]) for a in args))
        return jax.tree.map(lambda x: x.reshape(size, -1, *x.shape[1:]), out), jax.tree.map(lambda _: True, out)

    return flat
