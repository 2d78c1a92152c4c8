from collections import deque
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vatmart_jax.envs.rewards import reward_terms
from vatmart_jax.rl.replay_buffer import Episode, ReplayBuffer, Transition, hindsight
from vatmart_jax.rl.td3 import TD3, TD3Config, TD3State

OBSERVATION, ACTION = 4, 2
CONFIG = TD3Config(
    hidden=32,
    batch_size=128,
    learning_rate=3e-3,
    discount=0.5,
    tau=0.05,
    reward_scale=0.1,
    buffer_size=4096,
    grad_steps_per_iter=500,
)


@pytest.fixture(scope="module")
def td3() -> TD3:
    return TD3(CONFIG, OBSERVATION, ACTION)


@pytest.fixture(scope="module")
def learn(td3):
    return jax.jit(td3.learn)


@pytest.fixture(scope="module")
def fresh(td3) -> TD3State:
    return jax.jit(td3.init)(jax.random.key(1))


def best_action(obs):
    return jnp.stack([0.6 * obs[..., 0], -0.5 * obs[..., 1] * obs[..., 2]], -1)


@pytest.fixture(scope="module")
def replay() -> ReplayBuffer:
    """Two-step trials: in the first step (obs[3] = 0) actions do nothing; the second pays for the best action."""
    k1, k2 = jax.random.split(jax.random.key(0))
    obs = jax.random.uniform(k1, (CONFIG.buffer_size, OBSERVATION), minval=-1.0)
    obs = obs.at[:, 3].set(jnp.arange(CONFIG.buffer_size) % 2)
    last = obs[:, 3]
    action = jax.random.uniform(k2, (CONFIG.buffer_size, ACTION), minval=-1.0)
    reward = last * (10 - 20 * jnp.sum((action - best_action(obs)) ** 2, -1))
    steps = Transition(obs, action, reward, obs.at[:, 3].set(1), last)
    return ReplayBuffer.create(CONFIG.buffer_size, OBSERVATION, ACTION).insert(
        steps, jnp.ones(CONFIG.buffer_size, bool)
    )


@pytest.fixture(scope="module")
def learned(learn, fresh, replay):
    return learn(fresh, replay, jax.random.key(2))


def test_td3_finds_the_best_action_and_its_discounted_value(td3, learned):
    state, metrics = learned
    obs = jax.random.uniform(jax.random.key(3), (500, OBSERVATION), minval=-0.9, maxval=0.9)
    last = obs.at[:, 3].set(1)
    error = np.abs(td3.act(state.policy, last) - best_action(last))
    assert error.mean() < 0.1
    assert np.isfinite(list(metrics.values())).all()
    # What the best action is worth: 10, and the step before it the discount times that. Scaled.
    value = td3._values(state.critics, last, best_action(last))
    np.testing.assert_allclose(value.mean(1), 1.0, atol=0.15)
    value = td3._values(state.critics, obs.at[:, 3].set(0), jnp.zeros((500, ACTION)))
    np.testing.assert_allclose(value.mean(1), 0.5, atol=0.15)


def saturated(state: TD3State) -> TD3State:
    """A policy whose actions are all at the end of their range."""
    policy = jax.tree.map(jnp.copy, state.policy)
    policy["params"]["Dense_4"]["bias"] = jnp.full(ACTION, 20.0)
    return state.replace(policy=policy, target_policy=policy)


def test_a_saturated_policy_finds_its_way_back_and_without_the_penalty_does_not(td3, learn, fresh, replay):
    last = jax.random.uniform(jax.random.key(3), (500, OBSERVATION), minval=-0.9, maxval=0.9).at[:, 3].set(1)
    stuck = jax.jit(TD3(replace(CONFIG, pre_tanh_l2=0.0), OBSERVATION, ACTION).learn)
    error = {}
    for name, step in (("with", learn), ("without", stuck)):
        state = saturated(fresh)
        for k in range(3):
            state, _ = step(state, replay, jax.random.key(k))
        error[name] = float(np.abs(td3.act(state.policy, last) - best_action(last)).mean())
    assert error["with"] < 0.15 and error["without"] > 0.5


def test_learning_is_determined_by_its_keys(td3, learn, learned, fresh, replay):
    same, _ = learn(jax.jit(td3.init)(jax.random.key(1)), replay, jax.random.key(2))
    other, _ = learn(fresh, replay, jax.random.key(4))
    for a, b in zip(jax.tree.leaves(same), jax.tree.leaves(learned[0]), strict=True):
        np.testing.assert_array_equal(a, b)
    obs = jnp.ones((1, OBSERVATION))
    assert (td3.act(other.policy, obs) != td3.act(same.policy, obs)).any()


def test_critics_differ_and_targets_follow_slowly(td3, fresh, replay):
    state = fresh
    assert state.updates == 0
    first, second = (jax.tree.map(lambda x, k=k: x[k], state.critics) for k in (0, 1))
    kernels = [critic["params"]["Dense_0"]["kernel"] for critic in (first, second)]
    assert (kernels[0] != kernels[1]).all()
    steps = replay.sample(jax.random.key(0), CONFIG.batch_size)
    update = jax.jit(td3._update)
    once, _ = update(state, steps, jax.random.key(0))
    same = lambda a, b: all((x == y).all() for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))
    assert same(once.policy, state.policy) and same(once.target_critics, state.target_critics)
    assert not same(once.critics, state.critics)
    twice, _ = update(once, steps, jax.random.key(1))
    assert not same(twice.policy, state.policy)
    for target, old, new in (
        (twice.target_policy, state.policy, twice.policy),
        (twice.target_critics, state.critics, twice.critics),
    ):
        for t, o, n in zip(*map(jax.tree.leaves, (target, old, new)), strict=True):
            np.testing.assert_allclose(t, (1 - CONFIG.tau) * o + CONFIG.tau * n, atol=1e-6)


def test_exploration_noise_is_bounded_and_its_random_share_uniform(td3, fresh):
    policy, obs = fresh.policy, jnp.ones((4000, OBSERVATION))
    key = jax.random.key(5)
    np.testing.assert_array_equal(td3.explore(policy, obs, key, 0.0, 0.0), td3.act(policy, obs))
    noisy = td3.explore(policy, obs, key, 0.2, 0.0) - td3.act(policy, obs)
    np.testing.assert_allclose(noisy.std(0), 0.2, rtol=0.1)
    uniform = td3.explore(policy, obs, key, 0.2, 1.0)
    assert (np.abs(uniform) <= 1).all()
    np.testing.assert_allclose(uniform.std(0), 1 / np.sqrt(3), rtol=0.1)
    half = (td3.explore(policy, obs, key, 0.0, 0.5) == td3.act(policy, obs)).all(-1)
    assert 0.45 < half.mean() < 0.55


N, CAPACITY = 6, 8
insert = jax.jit(ReplayBuffer.insert)


def numbered(first: int, n: int) -> Transition:
    number = jnp.arange(first, first + n, dtype=jnp.float32)
    return Transition(number[:, None] + jnp.zeros(3), number[:, None], number, number[:, None] + jnp.ones(3), number)


@settings(deadline=None, max_examples=50)
@given(st.lists(st.lists(st.booleans(), min_size=N, max_size=N), max_size=6))
def test_the_ring_holds_the_last_kept_steps_as_a_list_would(keeps):
    ring, oracle = ReplayBuffer.create(CAPACITY, 3, 1), deque(maxlen=CAPACITY)
    for k, keep in enumerate(keeps):
        ring = insert(ring, numbered(1 + N * k, N), jnp.array(keep))
        oracle.extend(1 + N * k + i for i in range(N) if keep[i])
    assert ring.inserted == sum(map(sum, keeps))
    filled = min(int(ring.inserted), CAPACITY)
    assert sorted(np.asarray(ring.data.reward[:filled]).tolist()) == sorted(oracle)
    # All of a step stays together, and in order of arrival.
    np.testing.assert_array_equal(ring.data.obs[:filled, 0], ring.data.reward[:filled])
    np.testing.assert_array_equal(ring.data.next_obs[:filled, 2], ring.data.reward[:filled] + 1)
    start = int(ring.inserted) % CAPACITY if filled == CAPACITY else 0
    assert np.roll(ring.data.reward[:filled], -start).tolist() == list(oracle)


def test_an_insert_larger_than_the_ring_keeps_its_last_steps():
    keep = np.arange(30) % 3 != 0
    ring = ReplayBuffer.create(CAPACITY, 3, 1).insert(numbered(0, 30), jnp.array(keep))
    assert sorted(np.asarray(ring.data.reward).tolist()) == np.flatnonzero(keep)[-CAPACITY:].tolist()


def test_samples_are_uniform_over_what_was_inserted():
    ring = insert(ReplayBuffer.create(CAPACITY, 3, 1), numbered(1, N), jnp.array([True, True, False, True, True, True]))
    values, counts = np.unique(ring.sample(jax.random.key(0), 5000).reward, return_counts=True)
    assert values.tolist() == [1, 2, 4, 5, 6]
    assert (np.abs(counts / 5000 - 0.2) < 0.03).all()


K, B = 4, 300
GOALS, TOLERANCE = (0.1, 0.6), 0.15


@pytest.fixture(scope="module")
def episode() -> Episode:
    """Random trials: of one to four steps, some invalid from the start, some losing the grip in their last step."""
    rng = np.random.default_rng(0)
    length = rng.integers(0, K + 1, B)
    active = np.arange(K)[:, None] < length
    after = np.cumsum(rng.uniform(-0.05, 0.3, (K, B)) * active, 0)
    before = np.concatenate([np.zeros((1, B)), after[:-1]])
    lost = (rng.random(B) < 0.2) & (length > 0)
    held = ~(lost & (np.arange(K)[:, None] >= length - 1))
    task = rng.uniform(*GOALS, B)
    obs = rng.normal(size=(2, K, B, 5))
    for o, moved in zip(obs, (before, after), strict=True):
        o[..., 0], o[..., 1], o[..., 2] = moved, task, task - moved
    distance = rng.uniform(0, 0.2, (K, B))
    done = np.arange(K)[:, None] >= length - 1
    as_f32 = lambda x: jnp.asarray(x, jnp.float32)
    return Episode(
        as_f32(obs[0]), as_f32(rng.uniform(-1, 1, (K, B, 2))), as_f32(rng.normal(size=(K, B))), as_f32(obs[1]),
        jnp.asarray(done), jnp.asarray(active), as_f32(before), as_f32(after), as_f32(distance), jnp.asarray(held),
        as_f32(rng.uniform(0, 50, (K, B))),
    )  # fmt: skip


@pytest.fixture(scope="module")
def relabelled(episode):
    curiosity = jnp.linspace(0, 500, B)
    relabel = jax.jit(lambda key: hindsight(episode, key, GOALS, TOLERANCE, reward_terms, curiosity))
    copies, keep = relabel(jax.random.key(0))
    shaped = jax.tree.map(lambda x: np.asarray(x).reshape(K, B, *x.shape[1:]), copies)
    return shaped, np.asarray(keep).reshape(K, B), np.asarray(curiosity)


def test_hindsight_tasks_are_what_this_or_a_later_step_achieved(episode, relabelled):
    copies, keep, _ = relabelled
    after, active = np.asarray(episode.after), np.asarray(episode.active)
    later = set()
    assert keep.sum() > B / 4
    for k, b in zip(*np.nonzero(keep), strict=True):
        goal = copies.obs[k, b, 1]
        (steps,) = np.nonzero((after[k:, b] == goal) & active[k:, b])
        assert len(steps)
        later.add(int(steps[0]))
        assert GOALS[0] <= goal <= GOALS[1] and goal > episode.before[k, b]
        assert active[k, b] and episode.grasp_held[k, b]
    assert later == {0, 1, 2, 3}


def test_hindsight_changes_the_task_and_what_is_left_of_it_and_nothing_else(episode, relabelled):
    copies, keep, _ = relabelled
    for new, old, moved in (
        (copies.obs, episode.obs, episode.before),
        (copies.next_obs, episode.next_obs, episode.after),
    ):
        old, moved = np.asarray(old), np.asarray(moved)
        np.testing.assert_array_equal(new[..., [0, 3, 4]], old[..., [0, 3, 4]])
        np.testing.assert_allclose(new[keep][:, 2], (new[..., 1] - moved)[keep], atol=1e-6)
    np.testing.assert_array_equal(copies.obs[..., 1], copies.next_obs[..., 1])
    np.testing.assert_array_equal(copies.action, episode.action)


def test_hindsight_rewards_and_ends_are_those_of_the_new_task(episode, relabelled):
    copies, keep, curiosity = relabelled
    goal, before, after, distance = (
        copies.obs[..., 1],
        *map(np.asarray, (episode.before, episode.after, episode.distance)),
    )
    held = np.asarray(episode.grasp_held)
    success = (np.abs(goal - after) <= TOLERANCE * goal) & held
    expected = (
        300 * (np.abs(goal - before) - np.abs(goal - after))
        - 150 * distance
        - 300 * (distance > 0.1)
        + (500 - curiosity) * success
        - np.asarray(episode.cost)
    )
    np.testing.assert_allclose(copies.reward[keep], expected[keep], atol=1e-3)
    last = np.arange(K)[:, None] == K - 1
    np.testing.assert_array_equal(copies.done[keep], (success | last)[keep])
    assert 0 < success[keep].mean() < 1


def test_the_steps_of_an_episode_are_those_that_were_made(episode):
    steps, made = episode.transitions()
    assert steps.obs.shape == (K * B, 5) and steps.done.dtype == jnp.float32
    assert made.sum() == episode.active.sum()
    np.testing.assert_array_equal(steps.reward[B + 3], episode.reward[1, 3])
