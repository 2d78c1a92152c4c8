"""The resolved config of a run, as its folder carries it: what was trained, on what, how, by which version."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from vatmart_jax import __version__
from vatmart_jax.config import from_json, to_json
from vatmart_jax.envs import get_task
from vatmart_jax.envs.env import ACTION
from vatmart_jax.errors import UserError, summarize_error
from vatmart_jax.physics import BACKENDS
from vatmart_jax.pipeline import format_1
from vatmart_jax.pipeline.run_dir import read_config
from vatmart_jax.pipeline.settings import Settings
from vatmart_jax.priors import pretrained
from vatmart_jax.rl.agent import Agent, PolicyDescription, load_policy

FORMAT = 2


@dataclass(frozen=True)
class DataSource:
    """Which objects a run learned from."""

    kind: Literal["bundled", "folder", "external"]  # external: somebody else's folder, unknown here
    path: str | None = None  # of a folder

    def __post_init__(self) -> None:
        if (self.kind == "folder") != (self.path is not None):
            raise UserError(f"data of kind {self.kind}, path {self.path}: a folder has a path, and nothing else has")

    @classmethod
    def of(cls, data: Path | None) -> DataSource:
        """A folder, or the bundled objects."""
        return BUNDLED if data is None else cls("folder", str(data.resolve()))

    def to_json(self) -> dict[str, str]:
        return {"kind": self.kind} if self.path is None else {"kind": self.kind, "path": self.path}


BUNDLED, EXTERNAL = DataSource("bundled"), DataSource("external")


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """Enough to train the same run again, given its data."""

    task: str
    preset: str  # whose settings these were before flags changed them
    impl: str  # of the physics
    seed: int
    settings: Settings
    data: DataSource = BUNDLED
    more_data: tuple[str, ...] = ()  # folders whose training splits are trained on too
    version: str = __version__
    format: int = FORMAT

    def __post_init__(self) -> None:
        """Raises UserError for an unknown task or physics implementation."""
        get_task(self.task)
        BACKENDS.require(self.impl)

    def to_json(self) -> dict[str, Any]:
        """What config.json holds."""
        first = {"format": self.format, "version": self.version, "task": self.task}
        return first | to_json(self) | {"data": self.data.to_json()}

    @classmethod
    def from_json(cls, value: Mapping[str, Any], where: str = "config") -> RunConfig:
        """Of any format there was. Raises UserError, which names `where`, for what does not fit."""
        try:
            while (found := value.get("format", 1)) in MIGRATIONS:
                value = MIGRATIONS[found](value)
            if found != FORMAT:
                raise ValueError(f"format {found}, expected one up to {FORMAT}")
            return from_json(cls, dict(value), where)
        except (ValueError, KeyError, TypeError, AttributeError) as e:
            raise UserError(
                f"{where}: not a run's config ({summarize_error(e)}); use the version that wrote it, or train again"
            ) from e

    @classmethod
    def load(cls, folder: Path) -> RunConfig:
        """Of a run folder. Raises UserError where it holds none."""
        value = read_config(folder)
        if value.get("format", 1) == 1 and value.get("data") is None and pretrained.is_external(folder):
            value = {**value, "data": EXTERNAL.to_json()}
        return cls.from_json(value, f"{folder}/config.json")


def _from_format_1(value: Mapping[str, Any]) -> dict[str, Any]:
    """Settings by their new names, and data by its kind: a path, or null for the bundled objects."""
    data = value["data"]
    if not isinstance(data, Mapping):
        data = (BUNDLED if data is None else DataSource("folder", data)).to_json()
    return {**value, "format": 2, "data": data, "settings": format_1.settings(value["settings"])}


MIGRATIONS = {1: _from_format_1}
"""By the format they read; each gives the next one."""


def load_run_policy(folder: Path) -> tuple[Agent, Any]:
    """The agent and the parameters of a run's policy, whatever its format. Raises UserError, see `load_policy`."""
    if (folder / "policy.json").is_file():
        return load_policy(folder)
    config = RunConfig.load(folder)
    td3 = to_json(config.settings.explore.td3)
    description = PolicyDescription(agent="td3", config=td3, observation_size=33, action_size=ACTION, task=config.task)
    return load_policy(folder, description)
