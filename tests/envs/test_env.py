from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import Box, Cabinet, scene_bank, view_bank
from scipy import stats
from scipy.spatial.transform import Rotation

from vatmart_jax import rotations as rot
from vatmart_jax.data.banks import HINGE, SceneBank, ViewBank
from vatmart_jax.envs import EnvConfig, EnvState, TrialStart, make_env
from vatmart_jax.envs.rewards import reward_terms
from vatmart_jax.errors import UserError
from vatmart_jax.trajectory import WAYPOINTS, unpack_trajectory

BATCH, ACTION, OBSERVATION = 16, 6, 33
TASKS = ("push-door", "pull-door", "push-drawer", "pull-drawer")
KEY = jax.random.key(0)


def jit(f):
    """Most of what these tests cost is compilation."""
    return jax.jit(f, compiler_options={"xla_backend_optimization_level": 0})


class Trials:
    """An environment with its functions jitted."""

    def __init__(self, cabinets: tuple[SceneBank, ViewBank], task: str):
        self.env = make_env(*cabinets, task, config=EnvConfig(num_envs=BATCH))
        self.reset, self.step = jit(self.env.reset), jit(self.env.step)
        self.begin, self.execute = jit(self.env.begin_trials), jit(self.env.execute)
        self.sample = jit(lambda key: self.env.sample(key, 5000))

    def starts(self, contacts: slice, forward, task: float) -> TrialStart:
        """Every view at several of its contacts, head on, with one task."""
        views = self.env.views
        view = np.resize(np.arange(len(views)), BATCH)
        contact = np.resize(np.arange(16)[contacts], BATCH)
        up = -views.contact_normals[view, contact]
        rotation = rot.gripper_frame(jnp.asarray(up), jnp.broadcast_to(jnp.asarray(forward, jnp.float32), up.shape))
        return TrialStart(
            view=jnp.asarray(view, jnp.int32), contact=jnp.asarray(contact, jnp.int32), goal=jnp.full(BATCH, task),
            rotation=rotation,
        )  # fmt: skip

    def expert(self, state: EnvState) -> jax.Array:
        """The contact point's way along its joint in equal shares, from the observation alone."""
        obs, env = state.obs, self.env
        share = obs[:, 2:3] / (WAYPOINTS - state.waypoint)
        tip, contact, axis, nearest = obs[:, 12:15], obs[:, 20:23], obs[:, 23:26], obs[:, 26:29]
        hinge = env.task.joint_type == HINGE
        if hinge:
            then = nearest + rot.rotate(rot.matrix_from_rotvec(axis * share), contact - nearest)
        else:
            then = contact + axis * share
        move = then - (contact if env.task.grasps else tip)
        turn = axis * share if hinge else jnp.zeros_like(axis)
        return jnp.concatenate([move / env.config.max_translation, turn / env.config.max_rotation], -1)


@pytest.fixture(scope="module")
def runs(cabinets):
    made: dict[str, Trials] = {}

    def run(task: str) -> Trials:
        if task not in made:
            made[task] = Trials(cabinets, task)
        return made[task]

    return run


def random_actions(seed: int) -> jax.Array:
    return jax.random.uniform(jax.random.key(seed), (BATCH, ACTION), minval=-1.0)


def assert_sound(state: EnvState):
    """Shapes, dtypes, finite numbers, and flags that agree with each other."""
    assert state.obs.shape == (BATCH, OBSERVATION) and state.reward.shape == (BATCH,)
    assert state.trajectory.shape == (BATCH, 30) and state.progress.shape == (BATCH, WAYPOINTS)
    assert set(state.metrics) == {"guidance", "distance", "far", "success"}
    for leaf in jax.tree.leaves(state):
        assert leaf.dtype in (jnp.float32, jnp.int32, jnp.uint32, jnp.bool_), leaf.dtype
        assert np.isfinite(leaf).all()
    np.testing.assert_allclose(state.reward, sum(state.metrics.values()), atol=1e-3)
    assert not (state.success & ~state.valid).any() and not (state.valid & state.in_collision).any()
    assert (state.done | state.valid).all()


@pytest.mark.parametrize("task", TASKS)
def test_an_episode_of_random_actions_is_sound(runs, task):
    run = runs(task)
    state = run.reset(KEY)
    assert_sound(state)
    assert state.valid.any() and (state.residuals == 0).all()
    structure = jax.tree.map(lambda x: (x.shape, x.dtype), state)
    for k in range(WAYPOINTS):
        before, state = state, run.step(state, random_actions(k))
        assert_sound(state)
        assert jax.tree.map(lambda x: (x.shape, x.dtype), state) == structure
        assert (state.done | ~before.done).all()
    assert state.done.all()
    assert (run.reset._cache_size(), run.step._cache_size()) == (1, 1)


def test_resets_are_determined_by_their_key(runs):
    run = runs("push-door")
    a, b, c = run.reset(KEY), run.reset(KEY), run.reset(jax.random.key(1))
    assert all((x == y).all() for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))
    assert (a.start.goal != c.start.goal).all()


@pytest.mark.parametrize("task", TASKS)
def test_tasks_fit_the_room_and_approaches_the_cone(runs, task):
    env, start = runs(task).env, runs(task).sample(KEY)
    q, width = env.views.joint_pos[start.view], env.bank.joint_range[env.views.scene[start.view]]
    room = width - q if env.task.grasps else q
    assert (start.goal >= env.task.goal_range[0] - 1e-6).all()
    assert (start.goal <= np.minimum(env.task.goal_range[1], room) + 1e-6).all()
    assert np.isin(np.unique(env.views.direction[start.view]), [env.task.direction])
    inward = -env.views.contact_normals[start.view, start.contact]
    assert ((np.asarray(start.rotation)[:, :, 2] * inward).sum(-1) > np.cos(env.config.approach_cone) - 1e-5).all()
    np.testing.assert_allclose(np.linalg.det(start.rotation), 1, atol=1e-4)
    if task.startswith("pull"):
        share = env.views.contact_handle[start.view, start.contact].mean()
        assert abs(share - (0.9 + 0.1 / 2)) < 0.02


@pytest.mark.parametrize("task", ["push-door", "pull-drawer"])
def test_the_task_given_the_view_is_that_of_a_uniform_task_and_then_a_uniform_start(runs, task):
    env, rng = runs(task).env, np.random.default_rng(0)
    view = 1
    q, width = env.views.joint_pos[view], env.bank.joint_range[env.views.scene[view]]
    ours = np.asarray(env.sample_goal(KEY, jnp.full(2000, view)))
    t = rng.uniform(env.task.goal_range[0], min(env.task.goal_range[1], width), 2_000_000)
    start = rng.uniform(0, width - t) if env.task.grasps else rng.uniform(t, width)
    theirs = t[np.abs(start - q) < 0.002 * width]
    assert len(theirs) > 1000
    assert stats.ks_2samp(ours, theirs).pvalue > 1e-3


def test_categories_then_objects_are_balanced(runs):
    env, start = runs("push-door").env, runs("push-door").sample(KEY)
    scene = env.views.scene[start.view]
    for name, share in (("100", 0.25), ("200", 0.25), ("300", 0.5)):
        assert abs((env.bank.object_id[scene] == name).mean() - share) < 0.03
    # Views are unequal in number, and each is as likely as the others of its Scene.
    _, counts = np.unique(start.view[env.bank.object_id[scene] == "100"], return_counts=True)
    assert len(counts) == 3 and counts.min() > 0.7 * counts.max()


def test_trials_can_begin_at_a_pool_of_known_starts(runs):
    run = runs("push-door")
    pool = jax.tree.map(lambda x: x[:5], run.starts(slice(8), [0, 0, 1], 0.3))
    state = jax.jit(run.env.reset)(KEY, pool)
    rows = [
        np.flatnonzero((pool.view == v) & (pool.contact == c))
        for v, c in zip(*map(np.asarray, (state.start.view, state.start.contact)), strict=True)
    ]
    assert all(len(r) == 1 for r in rows) and len({int(r[0]) for r in rows}) > 2
    assert len(np.unique(state.start.goal)) == BATCH


class Awning(Cabinet):
    """A cabinet with a board above the drawer that juts out of the front."""

    def boards(self):
        front = -self.size[0] / 2 - 0.02
        return [*super().boards(), Box(np.array([front - 0.06, 0, 0]), np.array([0.06, 0.3, 0.01]))]


def test_a_hand_that_an_obstacle_stops_on_the_way_leaves_no_way():
    """Where the drawer is pushed shut below the board, the hand's long side is in its way, the short one is not."""
    objects = [Awning("100", "StorageFurniture", "train", (0.40, 0.60, 0.70), 1, 0, (0.0, 0.0, 0.0), 3)]
    env = make_env(scene_bank(objects), view_bank(objects), "push-drawer")
    view, contact = (x.ravel() for x in np.meshgrid(np.arange(3), np.arange(8)))
    up = jnp.asarray(-env.views.contact_normals[view, contact])
    starts = {
        side: TrialStart(
            view=jnp.asarray(view, jnp.int32), contact=jnp.asarray(contact, jnp.int32), goal=jnp.full(24, 0.1),
            rotation=rot.gripper_frame(up, jnp.broadcast_to(jnp.asarray(axis, jnp.float32), up.shape)),
        )
        for side, axis in (("upright", [0, 1, 0]), ("flat", [0, 0, 1]))
    }  # fmt: skip
    free, way = jit(env.is_collision_free), jit(env.path_is_free)
    height = env.views.contacts[view, contact][:, 2]
    upright, flat = (np.asarray(free(starts[side])) for side in ("upright", "flat"))  # the others are at the handle
    assert (upright & (height > -0.1)).any() and (upright & (height < -0.13)).any() and flat.any()
    assert way(starts["flat"])[flat].all()
    assert not way(starts["upright"])[height > -0.1].any()
    assert way(starts["upright"])[upright & (height < -0.13)].all()


def test_the_first_observation_says_where_the_hand_the_contact_and_the_joint_are(runs):
    for task in ("push-door", "push-drawer"):
        run = runs(task)
        start = run.starts(slice(8), [0, 0, 1], 0.2)
        state = run.begin(start)
        obs, env = np.asarray(state.obs), run.env
        views, bank = env.views, env.bank
        scene, near = views.scene[start.view], {"atol": 1e-5}
        frame = np.asarray(state.frame)
        local = lambda v, frame=frame: np.einsum("bji,bj->bi", frame, v)
        np.testing.assert_allclose(obs[:, :3], [[0, 0.2, 0.2]] * BATCH, **near)
        up = np.asarray(start.rotation)[:, :, 2]
        np.testing.assert_allclose(obs[:, 3:6], local(-(0.1122 + env.config.standoff) * up), **near)
        np.testing.assert_allclose(obs[:, 6:9], local(up), **near)
        np.testing.assert_allclose(obs[:, 12:15], local(-env.config.standoff * up), **near)
        np.testing.assert_allclose(obs[:, 15:23], 0, atol=2e-4)
        np.testing.assert_allclose(state.info["tip_distance"], env.config.standoff, atol=1e-5)
        hinge = task == "push-door"
        # x is the contact's motion when the part closes; z, or x for a drawer, the axis.
        np.testing.assert_allclose(obs[:, 23:26], [[0, 0, 1] if hinge else [1, 0, 0]] * BATCH, atol=1e-4)
        if hinge:
            point = np.asarray(state.point)
            arm = point - bank.part_pos[scene]
            arm[:, 2] = 0
            np.testing.assert_allclose(obs[:, 29], np.linalg.norm(arm, axis=-1), **near)
            np.testing.assert_allclose(obs[:, 26:29], local(-arm), **near)
            # Doors close towards the cabinet.
            assert (frame[:, 0, 0] > 0).all()
        else:
            np.testing.assert_allclose(frame[:, :, 0], [[1, 0, 0]] * BATCH, atol=1e-5)


def turned(cabinets: tuple[SceneBank, ViewBank], angle: float) -> tuple[SceneBank, ViewBank]:
    """The same cabinets, turned about z."""
    bank, views = cabinets
    turn = Rotation.from_rotvec([0, 0, angle])
    along = lambda quat: (turn * Rotation.from_quat(quat, scalar_first=True)).as_quat(scalar_first=True)
    apply = lambda v: turn.apply(v.reshape(-1, 3)).reshape(v.shape).astype(v.dtype)
    static = np.arange(len(bank.instance_shape)) < bank.static_start[-1]
    return (
        replace(
            bank,
            instance_pos=np.where(static[:, None], apply(bank.instance_pos), bank.instance_pos),
            instance_quat=np.where(static[:, None], along(bank.instance_quat), bank.instance_quat),
            part_pos=apply(bank.part_pos),
            part_quat=along(bank.part_quat),
        ),
        replace(views, contacts=apply(views.contacts), contact_normals=apply(views.contact_normals)),
    )


@pytest.mark.parametrize("task", ["push-door", "push-drawer"])
def test_the_policy_sees_the_same_when_the_whole_scene_is_turned(cabinets, runs, task):
    angle = 0.7
    run, other = runs(task), Trials(turned(cabinets, angle), task)
    start = run.starts(slice(16), [0.3, 0.2, 1], 0.2)
    matrix = jnp.asarray(Rotation.from_rotvec([0, 0, angle]).as_matrix(), jnp.float32)
    a, b = run.begin(start), other.begin(start.replace(rotation=matrix @ start.rotation))
    np.testing.assert_allclose(a.obs, b.obs, atol=1e-4)
    assert (a.valid == b.valid).all() and a.valid.any()
    if task == "push-drawer":
        return  # one joint type's physics are enough
    actions = run.expert(a) + 0.1 * random_actions(0)
    a, b = run.step(a, actions), other.step(b, actions)
    assert (np.abs(a.displacement) > 0.01).any()
    np.testing.assert_allclose(a.displacement, b.displacement, atol=2e-3)
    np.testing.assert_allclose(a.obs, b.obs, atol=1e-2)


@pytest.mark.parametrize("task", ["push-door", "push-drawer"])
def test_pushing_straight_on_the_front_closes_the_part_and_is_a_success(runs, task):
    run = runs(task)
    state = begun = run.begin(run.starts(slice(8), [0, 0, 1], 0.4 if task == "push-door" else 0.15))
    assert begun.valid.sum() > BATCH / 2
    for _ in range(WAYPOINTS):
        state = run.step(state, run.expert(state))
    np.testing.assert_array_equal(state.success, begun.valid)
    assert state.done.all()
    error = np.abs(state.displacement - state.start.goal)[begun.valid]
    assert error.max() < run.env.config.tolerance * state.start.goal[0]
    np.testing.assert_allclose(begun.physics.qpos[:, 0] - state.physics.qpos[:, 0], state.displacement, atol=1e-6)


def test_a_drawers_bar_is_grasped_across_and_pulled_open(runs):
    run = runs("pull-drawer")
    state = begun = run.begin(run.starts(slice(8, 16), [0, 1, 0], 0.15))
    assert begun.grasp_held.all() and begun.valid.all() and not begun.in_collision.any()
    # The bar is 0.015 thick.
    np.testing.assert_allclose(begun.physics.qpos[:, 7:].sum(-1), 0.015, atol=2e-3)
    for _ in range(WAYPOINTS):
        state = run.step(state, run.expert(state))
    assert state.success.all() and state.grasp_held.all()
    assert (state.physics.qpos[:, 0] > begun.physics.qpos[:, 0] + 0.1).all()


def test_a_grasp_of_the_bare_panel_fails_and_ends_the_trial(runs):
    run = runs("pull-drawer")
    state = run.begin(run.starts(slice(0, 8), [0, 1, 0], 0.15))
    assert not state.grasp_held.any() and state.done.all() and not state.valid.any()
    after = run.step(state, random_actions(0))
    assert not after.success.any() and (after.trajectory[:, 6:] == 0).all()


def test_starts_in_collision_are_invalid_and_stay_as_they_are(runs):
    run = runs("push-door")
    start = run.starts(slice(8), [0, 0, 1], 0.4)
    # Every other hand lies in the door's front.
    frames = np.asarray(start.rotation)
    aside = np.stack([frames[:, :, 2], frames[:, :, 1], -frames[:, :, 0]], -1)
    colliding = np.arange(BATCH) % 2 == 0
    start = start.replace(rotation=jnp.asarray(np.where(colliding[:, None, None], aside, frames)))
    state = begun = run.begin(start)
    for flags in (state.in_collision, ~state.valid, state.done):
        np.testing.assert_array_equal(flags, colliding)
    for _ in range(WAYPOINTS):
        state = run.step(state, run.expert(state))
    np.testing.assert_array_equal(state.success, ~colliding)
    np.testing.assert_array_equal(state.physics.backend_state[colliding], begun.physics.backend_state[colliding])
    assert (state.trajectory[colliding, 6:] == 0).all() and (state.reward[colliding] == 0).all()
    again = run.execute(start, state.residuals)
    np.testing.assert_array_equal(again.success, ~colliding)
    np.testing.assert_array_equal(again.displacement[colliding], 0)


@pytest.mark.parametrize("task", ["push-door", "pull-drawer"])
def test_a_recorded_trajectory_repeats_the_motion_and_is_zero_after_the_end(runs, task):
    run = runs(task)
    pulling = task.startswith("pull")
    state = run.begin(run.starts(slice(8, 16) if pulling else slice(8), [0, 1, 0.1] if pulling else [0, 0, 1], 0.15))
    ends = np.full(BATCH, WAYPOINTS)
    for k in range(WAYPOINTS):
        state = run.step(state, 1.4 * run.expert(state) + 0.1 * random_actions(k))
        ends = np.where(state.done & (ends == WAYPOINTS), k + 1, ends)
    assert len(set(ends)) > 1 and (ends < WAYPOINTS).any()
    frames, residuals = unpack_trajectory(state.trajectory)
    np.testing.assert_array_equal(residuals, state.residuals)
    moves = np.abs(residuals).sum(-1) > 0
    np.testing.assert_array_equal(moves, np.arange(WAYPOINTS) < ends[:, None])
    again = run.execute(state.start.replace(rotation=frames), residuals)
    for k in range(WAYPOINTS):
        np.testing.assert_allclose(again.progress[ends > k, k], state.progress[ends > k, k], atol=1e-3)


def test_open_loop_trials_count_only_how_they_end(runs):
    run = runs("push-door")
    start = run.starts(slice(8), [0, 0, 1], 0.2)
    far = run.begin(start.replace(goal=jnp.full(BATCH, 0.8)))
    for _ in range(WAYPOINTS):
        far = run.step(far, run.expert(far))
    # The first waypoint of a long push is a short task's success, its end is not.
    past = run.execute(start, far.residuals)
    assert (np.abs(past.progress[:, 0] - 0.2) < 0.03).any()
    assert not past.success.any() and past.valid.all()
    exact = run.execute(start.replace(goal=far.displacement), far.residuals)
    assert exact.success.all()


def test_rewards_are_the_papers(runs):
    task, before, after = np.array([0.5, 0.5, 0.5, 0.2]), np.array([0, 0.3, 0.4, 0.3]), np.array([0.2, 0.2, 0.5, 0.2])
    distance, success = np.array([0.05, 0.1, 0.11, 0.3]), np.array([False, False, True, True])
    terms = reward_terms(task, before, after, distance, success)
    np.testing.assert_allclose(terms["guidance"], [60, -30, 30, 30], atol=1e-4)
    np.testing.assert_allclose(terms["distance"], [-7.5, -15, -16.5, -45], atol=1e-4)
    np.testing.assert_allclose(terms["far"], [0, 0, -300, -300])
    np.testing.assert_allclose(terms["success"], [0, 0, 500, 500])
    run = runs("push-door")
    state = run.begin(run.starts(slice(8), [0, 0, 1], 0.4))
    for k in range(WAYPOINTS):
        before, state = state, run.step(state, run.expert(state) + 0.2 * random_actions(k))
        left = [np.abs(s.start.goal - s.displacement) for s in (before, state)]
        d = np.asarray(state.info["tip_distance"])
        success = np.abs(state.start.goal - state.displacement) <= 0.15 * state.start.goal
        expected = 300 * (left[0] - left[1]) - 150 * d - 300 * (d > 0.1) + 500 * success
        np.testing.assert_allclose(state.reward, np.where(before.done, 0, expected), atol=0.05)


def test_a_hand_strains_as_far_as_it_is_from_where_it_was_sent(runs):
    run = runs("pull-drawer")
    begun = run.begin(run.starts(slice(8, 16), [0, 1, 0], 0.15))
    stay = jnp.zeros((BATCH, WAYPOINTS, 6))
    across = stay.at[:, 0, 2].set(0.1)  # the drawer gives way along its axis only
    for residuals, low, high in ((stay, 0.0, 0.01), (across, 0.03, 0.1)):
        state = run.execute(begun.start, residuals)
        tracking_penalty = np.asarray(run.env.tracking_error(state))
        assert state.grasp_held.all() and (tracking_penalty >= low).all() and (tracking_penalty < high).all()


def test_a_nan_action_fails_its_own_trial_and_no_other(runs):
    run = runs("push-door")
    begun = run.begin(run.starts(slice(8), [0, 0, 1], 0.4))
    actions = run.expert(begun)
    sound, broken = run.step(begun, actions), run.step(begun, actions.at[3, 1].set(jnp.nan))
    others = np.arange(BATCH) != 3
    assert broken.done[3] and not broken.valid[3] and not broken.success[3]
    np.testing.assert_array_equal(broken.obs[others], sound.obs[others])
    assert np.isfinite(broken.obs).all() and np.isfinite(broken.reward).all()


def test_data_without_the_tasks_parts_or_room_is_refused_by_the_tasks_name(cabinets):
    bank, views = cabinets
    doors = np.flatnonzero(bank.joint_type == HINGE)
    with pytest.raises(UserError, match=r"no drawer \(slide\), which task push-drawer needs"):
        make_env(bank.select(doors), views.of_scenes(doors), "push-drawer")
    with pytest.raises(UserError, match=r"no view of a door \(hinge\) that can be moved by task pull-door"):
        make_env(bank, views.select(views.direction < 0), "pull-door")
    shut = replace(views, joint_pos=np.full_like(views.joint_pos, 0.01))
    with pytest.raises(UserError, match="push-door"):
        make_env(bank, shut, "push-door")
