"""A new gripper in one file: MJCF text, its dimensions, a name for PhysicsConfig."""

import jax

from vatmart_jax.envs import EnvConfig, make_env
from vatmart_jax.envs.scripted_policy import run_scripted_policy
from vatmart_jax.physics import GRIPPERS, Gripper, PhysicsConfig

SLIM = """
<mujoco model="slim">
  <default><default class="slim"><geom type="box" contype="2" conaffinity="1" group="3"/></default></default>
  <worldbody>
    <body name="hand">
      <geom name="palm" class="slim" size=".03 .05 .03" pos="0 0 .03"/>
      <body name="left_finger" pos="0 0 .06">
        <joint name="left_finger" type="slide" axis="0 1 0" range="0 .05"/>
        <geom name="left" class="slim" size=".008 .005 .03" pos="0 .005 .03"/>
      </body>
      <body name="right_finger" pos="0 0 .06">
        <joint name="right_finger" type="slide" axis="0 -1 0" range="0 .05"/>
        <geom name="right" class="slim" size=".008 .005 .03" pos="0 -.005 .03"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
GRIPPERS.register(
    "slim", Gripper(name="slim", mjcf=SLIM, tip_offset=0.12, max_opening=0.05, geoms=("palm", "left", "right"))
)


def test_a_new_gripper_pulls_drawers_open(cabinets):
    env = make_env(*cabinets, "pull-drawer", config=EnvConfig(num_envs=24), physics=PhysicsConfig(gripper="slim"))
    final = run_scripted_policy(env, env.sample(jax.random.key(0), 24), jax.random.key(1))
    assert final.success.mean() > 0.7
