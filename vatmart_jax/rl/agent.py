"""What a learner of the exploration stage is, and its policy as a file that loads by path alone."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Protocol

import jax
import jax.numpy as jnp
from flax import serialization

from vatmart_jax.atomic_io import write_bytes, write_json
from vatmart_jax.config import from_json, to_json
from vatmart_jax.errors import UserError, summarize_error
from vatmart_jax.registry import Registry
from vatmart_jax.rl.replay_buffer import ReplayBuffer

FORMAT = 2
POLICY, DESCRIPTION = "policy.msgpack", "policy.json"
Metrics = Mapping[str, jax.Array]


class Agent(Protocol):
    """Pure functions of a state that is a pytree of arrays. Made as `Agent(config, observation_size, action_size)`.

    Shapes: B trials, O numbers observed, A of an action.
    """

    name: ClassVar[str]  # in AGENTS
    config_type: ClassVar[type]  # dataclass of `config`
    config: Any
    observation_size: int
    action_size: int

    def init(self, key: jax.Array) -> Any:
        """A fresh state. Consumes the key."""
        ...

    def act(self, policy: Any, obs: jax.Array) -> jax.Array:
        """[B, O] -> [B, A] in [-1, 1]."""
        ...

    def explore(
        self, policy: Any, obs: jax.Array, key: jax.Array, *, noise: jax.Array | float, random: jax.Array | float
    ) -> jax.Array:
        """Actions to learn from: noise as share of the range, and a share `random` of uniform ones. Consumes the
        key."""
        ...

    def update(self, state: Any, replay: ReplayBuffer, key: jax.Array) -> tuple[Any, Metrics]:
        """What is learned from one iteration's trials. Consumes the key."""
        ...

    def acting_params(self, state: Any) -> Any:
        """The policy that acts while it is trained."""
        ...

    def policy_params(self, state: Any) -> Any:
        """The policy that a run keeps."""
        ...


AGENTS: Registry[Any] = Registry("agent")
AGENTS.register("td3", "vatmart_jax.rl.td3:TD3")


@dataclass(frozen=True, kw_only=True)
class PolicyDescription:
    """policy.json: what reads the parameters beside it."""

    agent: str  # in AGENTS
    config: Mapping[str, Any]  # of the agent, as JSON has it
    observation_size: int
    action_size: int
    task: str

    def make_agent(self, where: str) -> Agent:
        """Raises UserError, which names the file `where`, for a description that fits no agent."""
        kind = AGENTS.get(self.agent)
        try:
            return kind(from_json(kind.config_type, dict(self.config)), self.observation_size, self.action_size)
        except (ValueError, TypeError) as e:
            raise UserError(f"{where}: describes no policy ({summarize_error(e)}); train again") from e


def save_policy(folder: Path, agent: Agent, policy: Any, task: str) -> None:
    """Write policy.msgpack, and beside it what reads it."""
    description = {
        "format": FORMAT,
        "agent": agent.name,
        "config": to_json(agent.config),
        "observation_size": agent.observation_size,
        "action_size": agent.action_size,
        "task": task,
    }
    write_bytes(folder / POLICY, serialization.to_bytes(jax.device_get(policy)))
    write_json(folder / DESCRIPTION, description)


def load_policy(folder: Path, description: PolicyDescription | None = None) -> tuple[Agent, Any]:
    """The agent and the parameters of its policy. `description` serves where there is no policy.json (format 1).

    Raises UserError where a file is missing, damaged, or holds other networks than its description says.
    """
    path = Path(folder) / POLICY
    described = Path(folder) / DESCRIPTION
    if description is None or described.is_file():
        description = _read_description(described)
    agent = description.make_agent(str(described))
    expected = jax.eval_shape(lambda key: agent.policy_params(agent.init(key)), jax.random.key(0))
    try:
        restored: Any = serialization.msgpack_restore(path.read_bytes())
        policy = serialization.from_state_dict(expected, restored)
        shapes = jax.tree.map(lambda e, p: e.shape == p.shape and e.dtype == p.dtype, expected, policy)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as e:
        raise UserError(f"{path}: cannot be read ({summarize_error(e)}); finish the run, or train again") from e
    if not all(jax.tree.leaves(shapes)):
        raise UserError(f"{path}: holds other networks than its description says; train again")
    return agent, jax.tree.map(jnp.asarray, policy)


def _read_description(path: Path) -> PolicyDescription:
    try:
        found = json.loads(path.read_text())
        if found.pop("format", None) != FORMAT:
            raise ValueError(f"not of format {FORMAT}")
        return PolicyDescription(**found)
    except (OSError, ValueError, TypeError, AttributeError) as e:
        raise UserError(f"{path}: cannot be read ({summarize_error(e)}); finish the run, or train again") from e
