"""One MuJoCo template for every Scene of a joint type: the shared model, and the fields in which Scenes differ.

Each Scene is also compiled alone, and what the compiler computed is copied: a simulation in a batch of different
objects is bit-identical to the Scene's own model.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from mjcf_assets import scene_template
from vatmart_jax.data.banks import HINGE, SceneBank

TIP = 0.1122  # from the hand's origin to the fingertips along z, unit lengths
FINGER_OPEN = 0.04  # of each finger
N_QPOS, N_CTRL = 9, 8  # part, hand (x y z rx ry rz), two fingers; actuators drive all but the part
PART, HAND, FINGERS = 0, slice(1, 7), slice(7, 9)

# What the compiler makes different between Scenes, less what nothing reads with the midphase off (bvh_*, mesh_*).
SCENE_FIELDS = (
    "geom_dataid", "geom_pos", "geom_quat", "geom_rbound", "geom_aabb", "geom_size", "geom_sameframe",
    "body_pos", "body_quat", "body_ipos", "body_iquat", "body_mass", "body_inertia", "body_subtreemass",
    "body_invweight0", "body_sameframe", "body_simple",
    "jnt_axis", "jnt_range", "jnt_pos", "dof_invweight0", "dof_M0", "actuator_acc0",
)  # fmt: skip


@dataclass(frozen=True)
class PhysicsConfig:
    """Constants of the simulation, chosen by experiment (docs/physics.md). SI units; one unit length is one metre."""

    timestep: float = 0.004
    """halving it changes the final joint value by under 1 mrad or 1 mm in the median"""
    steps_per_waypoint: int = 100
    """0.4 s; 0.6 s gives the same success of scripted pushes"""
    ramp_fraction: float = 0.7
    """min-jerk over this share of a waypoint, then hold: coasting dies within the hold"""
    iterations: int = 10
    """Newton converges in 5 with the pyramidal cone"""
    ls_iterations: int = 10
    impratio: float = 4.0
    """pyramidal cone, 2 mm slip in a pull; elliptic with 10 needs 50 iterations"""
    friction: float = 2.0
    torsional_friction: float = 0.005
    contact_solref: tuple[float, float] = (0.01, 1.0)
    contact_solimp: tuple[float, float, float] = (0.95, 0.99, 0.001)
    """default contacts and limits are too soft at 60 N on light parts"""
    hand_mass: float = 1.0
    hand_inertia: float = 0.01
    hand_armature: float = 0.02
    slide_gains: tuple[float, float, float] = (5000.0, 160.0, 60.0)
    """kp, kv, force limit (N) of the hand's slides: under 0.5 mm tracking error in free motion"""
    hinge_gains: tuple[float, float, float] = (500.0, 8.0, 30.0)
    """kp, kv, torque limit (Nm) of the hand's hinges"""
    finger_gains: tuple[float, float, float] = (600.0, 30.0, 30.0)
    finger_mass: float = 0.05
    finger_inertia: float = 2e-5
    finger_armature: float = 0.1
    part_inertia: tuple[float, float] = (0.02, 0.2)
    """joint-space inertia every part is scaled to: hinge (kg m2), slide (kg); density makes 1 to 62 kg of them"""
    part_damping: tuple[float, float] = (2.0, 10.0)
    """hinge (Nms/rad), slide (Ns/m): with the inertia above, coasting dies within hundredths of a second"""


@dataclass(frozen=True)
class Template:
    """The compiled shared model and, per Scene, the fields in which Scenes differ."""

    model: mujoco.MjModel  # of Scene 0, with the shapes of all Scenes in its mesh table
    fields: dict[str, np.ndarray]  # name of SCENE_FIELDS -> [S, ...]


def template(bank: SceneBank, config: PhysicsConfig) -> Template:
    """Compile a bank whose Scenes all have one joint type. Raises ValueError where they have not."""
    if len(bank) == 0 or len(set(bank.joint_type.tolist())) != 1:
        raise ValueError("a template needs one or more Scenes, all of one joint type; use SceneBank.select")
    slots = (int(np.diff(bank.static_start).max()), int(np.diff(bank.part_start).max()))
    all_shapes = range(len(bank.hull_start) - 1)
    model = _spec(bank, 0, slots, config, all_shapes).compile()
    rows: dict[str, list[np.ndarray]] = {name: [] for name in SCENE_FIELDS}
    for scene in range(len(bank)):
        own = scene_model(bank, scene, config, slots)
        for name in SCENE_FIELDS:
            value = getattr(own, name).copy()
            if name == "geom_dataid":
                names = [own.mesh(i).name if i >= 0 else None for i in value]
                value = np.array([-1 if n is None else model.mesh(n).id for n in names], value.dtype)
            rows[name].append(value)
    _scale_part(model, bank, config)
    return Template(model, {name: np.stack(values) for name, values in rows.items()})


def scene_model(
    bank: SceneBank, scene: int, config: PhysicsConfig, slots: tuple[int, int] | None = None
) -> mujoco.MjModel:
    """One Scene's own model; `slots` (static, part) pads it to a template's number of geoms."""
    placed = _instances(bank, scene)
    slots = slots or (len(placed[0]), len(placed[1]))
    used = sorted(set(bank.instance_shape[np.concatenate(placed)].tolist())) if bank.collision == "hull" else []
    model = _spec(bank, scene, slots, config, used).compile()
    _scale_part(model, bank, config)
    return model


def _instances(bank: SceneBank, scene: int) -> tuple[np.ndarray, np.ndarray]:
    static = np.arange(bank.static_start[scene], bank.static_start[scene + 1])
    return static, np.arange(bank.part_start[scene], bank.part_start[scene + 1])


def _mesh_name(shape: int) -> str:
    return f"shape_{shape}"


def _spec(bank: SceneBank, scene: int, slots: tuple[int, int], config: PhysicsConfig, shapes) -> mujoco.MjSpec:
    spec = mujoco.MjSpec.from_string(scene_template())
    spec.compiler.degree = False
    option = spec.option
    option.timestep, option.impratio = config.timestep, config.impratio
    option.iterations, option.ls_iterations = config.iterations, config.ls_iterations
    # The midphase trusts bvh_aabb, which is not among the fields a Batch can expand per Scene.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE

    hull_bank = bank.collision == "hull"
    for shape in shapes:
        _add_mesh(spec, _mesh_name(shape), bank.hull(shape))
    _add_mesh(spec, "parked", 1e-3 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]))

    contact = {
        "condim": 4,
        "friction": [config.friction, config.torsional_friction, 1e-4],
        "solref": list(config.contact_solref),
        "solimp": [*config.contact_solimp, 0.5, 2],
    }
    for geom in spec.geoms:
        for name, value in contact.items():
            setattr(geom, name, value)

    part = spec.body("part")
    part.pos, part.quat = bank.part_pos[scene], bank.part_quat[scene]
    hinge = bank.joint_type[scene] == HINGE
    part.add_joint(
        name="part",
        type=mujoco.mjtJoint.mjJNT_HINGE if hinge else mujoco.mjtJoint.mjJNT_SLIDE,
        axis=bank.axis[scene],
        range=[0, bank.joint_range[scene]],
        limited=True,
        damping=[config.part_damping[bank.joint_type[scene]], 0, 0],
        solref_limit=list(config.contact_solref),
        solimp_limit=[*config.contact_solimp, 0.5, 2],
    )
    for body, rows, count in zip((spec.body("object"), part), _instances(bank, scene), slots, strict=True):
        for slot in range(count):
            common = {"name": f"{body.name}_{slot}", "contype": 1, "conaffinity": 2, **contact}
            if slot >= len(rows):
                # Far below, so that no broadphase test passes.
                place = {"pos": [0, 0, -50], "mass": 0}
                common |= {"meshname": "parked"} if hull_bank else {"size": [1e-3] * 3}
            else:
                row = rows[slot]
                shape = int(bank.instance_shape[row])
                place = {"pos": bank.instance_pos[row], "quat": bank.instance_quat[row], "density": 100}
                common |= {"meshname": _mesh_name(shape)} if hull_bank else {"size": bank.box_size[shape]}
            kind = mujoco.mjtGeom.mjGEOM_MESH if hull_bank else mujoco.mjtGeom.mjGEOM_BOX
            body.add_geom(type=kind, **common, **place)

    hand = spec.body("hand")
    hand.mass, hand.inertia, hand.explicitinertial = config.hand_mass, [config.hand_inertia] * 3, True
    for joint in hand.joints[3:]:
        joint.armature = config.hand_armature
    for side in ("left_finger", "right_finger"):
        finger = spec.body(side)
        finger.mass, finger.inertia, finger.explicitinertial = config.finger_mass, [config.finger_inertia] * 3, True
        finger.joints[0].armature = config.finger_armature
    gains = [config.slide_gains] * 3 + [config.hinge_gains] * 3 + [config.finger_gains] * 2
    names = [joint.name for joint in hand.joints] + ["left_finger", "right_finger"]
    for name, (kp, kv, limit) in zip(names, gains, strict=True):
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=kp, kv=kv)
        actuator.forcerange, actuator.forcelimited = [-limit, limit], True
    return spec


def _add_mesh(spec: mujoco.MjSpec, name: str, vertices: np.ndarray) -> None:
    mesh = spec.add_mesh(name=name)
    mesh.uservert = np.asarray(vertices, np.float64).ravel()
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX


def _scale_part(model: mujoco.MjModel, bank: SceneBank, config: PhysicsConfig) -> None:
    """Scale the part's mass and inertia so that its joint-space inertia is the configured one."""
    ratio = config.part_inertia[int(bank.joint_type[0])] / model.dof_M0[0]
    part = model.body("part").id
    model.body_mass[part] *= ratio
    model.body_inertia[part] *= ratio
    mujoco.mj_setConst(model, mujoco.MjData(model))
