# MuJoCo's compiled names are invisible to pyright.
# pyright: reportAttributeAccessIssue=false

"""One MuJoCo template for every Scene of a joint type: the shared model, and the fields in which Scenes differ.

Each Scene is also compiled alone, and what the compiler computed is copied: a simulation in a batch of different
objects is bit-identical to the Scene's own model.
"""

from __future__ import annotations

from dataclasses import dataclass
from xml.etree import ElementTree

import mujoco
import numpy as np

from mjcf_assets import scene_template
from vatmart_jax.data.banks import HINGE, SceneBank
from vatmart_jax.physics.config import PhysicsConfig
from vatmart_jax.physics.gripper import GRIPPERS, Gripper

# What the compiler makes different between Scenes, less what nothing reads with the midphase off (bvh_*, mesh_*).
SCENE_FIELDS = (
    "geom_dataid", "geom_pos", "geom_quat", "geom_rbound", "geom_aabb", "geom_size", "geom_sameframe",
    "body_pos", "body_quat", "body_ipos", "body_iquat", "body_mass", "body_inertia", "body_subtreemass",
    "body_invweight0", "body_sameframe", "body_simple",
    "jnt_axis", "jnt_range", "jnt_pos", "dof_invweight0", "dof_M0", "actuator_acc0",
)  # fmt: skip


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
    spec = _template_spec(GRIPPERS.get(config.gripper))
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

    return spec


def _template_spec(gripper: Gripper) -> mujoco.MjSpec:
    """The Scene template with the gripper under `gripper_base`, on six joints of its own, all of them actuated."""
    scene, own = ElementTree.fromstring(scene_template()), ElementTree.fromstring(gripper.mjcf_text())
    # In the text, for MjSpec.attach warns of names without a prefix.
    base = next(body for body in scene.iter("body") if body.get("name") == "gripper_base")
    (root,) = own.findall("worldbody/body")
    base.append(root)
    scene[0:0] = own.findall("default")
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(scene, "unicode"))
    spec.compiler.degree = False
    hand = spec.body(root.get("name"))
    hand.mass, hand.inertia, hand.explicitinertial = gripper.hand_mass, [gripper.hand_inertia] * 3, True
    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    for k, name in enumerate(gripper.hand_joints):
        joint = hand.add_joint(name=name, type=slide if k < 3 else hinge, axis=np.eye(3)[k % 3])
        joint.armature = 0.0 if k < 3 else gripper.hand_armature
    for name in gripper.finger_joints:
        joint = spec.joint(name)
        joint.armature = gripper.finger_armature
        finger = joint.parent
        finger.mass, finger.inertia, finger.explicitinertial = gripper.finger_mass, [gripper.finger_inertia] * 3, True
    for name, gains in gripper.actuators:
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=gains.kp, kv=gains.kv)
        actuator.forcerange, actuator.forcelimited = [-gains.limit, gains.limit], True
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
