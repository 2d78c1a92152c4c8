"""Grippers: what the compiled model has of them, and that each of them pushes and pulls."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from vatmart_jax.envs import EnvConfig, make_env
from vatmart_jax.envs.scripted_policy import run_scripted_policy
from vatmart_jax.errors import UserError
from vatmart_jax.physics import GRIPPERS, PhysicsConfig
from vatmart_jax.physics.scene_model import scene_model

TRIALS = 24
REGISTERED = ("panda", "robotiq_2f85")


@pytest.mark.parametrize("name", REGISTERED)
def test_joints_and_actuators_are_in_the_order_of_qpos(cabinets, name):
    gripper, model = GRIPPERS.get(name), scene_model(cabinets[0], 0, PhysicsConfig(gripper=name))
    assert (model.nq, model.nu) == (gripper.num_qpos, gripper.num_ctrl)
    joints = [model.joint(i).name for i in range(model.njnt)]
    assert joints == ["part", *gripper.hand_joints, *gripper.finger_joints]
    assert [model.actuator(i).name for i in range(model.nu)] == joints[1:]
    assert [joints[i] for i in range(*gripper.finger_qpos.indices(model.nq))] == list(gripper.finger_joints)
    np.testing.assert_allclose(model.jnt_range[gripper.finger_qpos], [[0, gripper.max_opening]] * 2)
    np.testing.assert_allclose(model.actuator_gainprm[:, 0], [gains.kp for _, gains in gripper.actuators])
    np.testing.assert_allclose(model.actuator_forcerange[:, 1], [gains.limit for _, gains in gripper.actuators])
    assert model.body_mass[model.body("hand").id] == gripper.hand_mass


@pytest.mark.parametrize("name", REGISTERED)
def test_the_tip_offset_is_where_the_fingers_end(cabinets, name):
    gripper, model = GRIPPERS.get(name), scene_model(cabinets[0], 0, PhysicsConfig(gripper=name))
    finger = model.geom(gripper.geoms[1])
    end = model.body_pos[finger.bodyid[0]] + finger.pos + [0, 0, finger.size[2]]
    np.testing.assert_allclose(end[2], gripper.tip_offset, atol=1e-3)


@pytest.mark.parametrize("task", ["push-door", "pull-door", "push-drawer", "pull-drawer"])
def test_the_robotiq_pushes_and_pulls(cabinets, task):
    physics = PhysicsConfig(gripper="robotiq_2f85")
    env = make_env(*cabinets, task, config=EnvConfig(num_envs=TRIALS), physics=physics)
    final = run_scripted_policy(env, env.sample(jax.random.key(0), TRIALS), jax.random.key(1))
    assert final.success.mean() >= 0.8


def test_an_unknown_gripper_is_refused_with_the_known_ones(cabinets):
    with pytest.raises(UserError, match="gripper 'claw' is not known; use one of panda, robotiq_2f85"):
        scene_model(cabinets[0], 0, PhysicsConfig(gripper="claw"))
