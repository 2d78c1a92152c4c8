"""The run folder: config, metrics, checkpoints. Rerunning the same command resumes an interrupted run."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import orbax.checkpoint as ocp
from filelock import FileLock, Timeout

from vatmart_jax.atomic_io import write_json, write_text
from vatmart_jax.errors import UserError, summarize_error

_LOCK = ".lock"


class RunError(UserError):
    """A run folder cannot be used."""


class RunDir:
    """One run folder, which one process at a time may have open. Use as a context manager.

    config.json       the resolved config; a folder that holds another one is refused
    metrics.jsonl     one line per unit of work
    checkpoints/      what training carries, the last two states
    .lock             held while the folder is open
    """

    def __init__(self, folder: Path, config: Mapping[str, Any]):
        """Opens or makes the folder. Raises RunError where it holds something else, or another process has it open."""
        self.folder = Path(folder)
        check_folder(self.folder, config)
        self.folder.mkdir(parents=True, exist_ok=True)
        self._lock = FileLock(self.folder / _LOCK)
        try:
            self._lock.acquire(timeout=0)
        except Timeout:
            raise RunError(
                f"{self.folder}: another process trains in this folder; wait for it, or choose another folder"
            ) from None
        try:
            self._open(config)
        except BaseException:
            self._lock.release()
            raise

    def _open(self, config: Mapping[str, Any]) -> None:
        check_folder(self.folder, config)  # another process may have made it meanwhile
        write_json(self.folder / "config.json", dict(config))
        # Orbax writes to a temporary name and renames; async saving would hold device buffers that jit may reuse.
        options = ocp.CheckpointManagerOptions(max_to_keep=2, enable_async_checkpointing=False)
        self._checkpoints = ocp.CheckpointManager((self.folder / "checkpoints").absolute(), options=options)
        self.metrics = self.folder / "metrics.jsonl"
        self._saved_at = time.monotonic()
        self._lines = 0

    def log(self, record: dict[str, Any]) -> None:
        """Append one line to metrics.jsonl."""
        with self.metrics.open("a") as f:
            f.write(json.dumps(record) + "\n")
        self._lines += 1

    def save(self, state: Any, at_least_every: float = 0.0) -> None:
        """Checkpoint a pytree of arrays, unless the last one is younger than `at_least_every` seconds."""
        if time.monotonic() - self._saved_at < at_least_every:
            return
        tree = {"state": jax.tree.map(_plain, state), "lines": jnp.int32(self._lines)}
        self._checkpoints.save((self._checkpoints.latest_step() or 0) + 1, args=ocp.args.StandardSave(tree))
        self._saved_at = time.monotonic()

    def restore(self, state: Any) -> Any:
        """The last checkpointed state, or `state` itself, which gives shapes and types, where there is none.

        Metrics logged after that checkpoint are dropped: their work is done again. A damaged checkpoint gives way to
        the one before; RunError where none can be read, and all are left.
        """
        steps = sorted(self._checkpoints.all_steps(), reverse=True)
        like = {"state": jax.tree.map(_plain, state), "lines": jnp.int32(0)}
        problems: dict[int, str] = {}
        for step in steps:
            try:
                found = self._checkpoints.restore(step, args=ocp.args.StandardRestore(like))
            except (ValueError, KeyError, OSError, TypeError) as e:
                problems[step] = summarize_error(e)[:120]
                continue
            for damaged in problems:
                self._checkpoints.delete(damaged)
            self._truncate(int(found["lines"]))
            return jax.tree.map(lambda kind, value: _as(kind, value), state, found["state"])
        if problems:
            raise RunError(
                f"{self.folder}/checkpoints: cannot be read ({'; '.join(f'{k}: {v}' for k, v in problems.items())}); "
                f"go on with the version that wrote them, or delete {self.folder} to start over"
            )
        self._truncate(0)
        return state

    def __enter__(self) -> RunDir:
        return self

    def __exit__(self, *_: object) -> None:
        self._checkpoints.close()
        self._lock.release()

    def _truncate(self, lines: int) -> None:
        self._lines = lines
        if self.metrics.exists():
            kept = self.metrics.read_text().splitlines(keepends=True)[:lines]
            write_text(self.metrics, "".join(kept))


def check_folder(folder: Path, config: Mapping[str, Any]) -> None:
    """Raises RunError where the folder holds something else than a run with this config."""
    path = folder / "config.json"
    if path.exists():
        held = _read_json(path)
        if "format" in config and "format" not in held and "settings" in held:
            raise RunError(
                f"{folder}: holds a run of version {held.get('version')} (format 1), which can be evaluated but not "
                "resumed here; go on with that version, or choose another folder"
            )
        changed = sorted(k for k in held.keys() | config.keys() if held.get(k) != config.get(k))
        if changed:
            raise RunError(
                f"{folder}: holds a run with another config ({', '.join(changed)} differ); "
                "choose another folder, or delete it"
            )
    elif folder.exists() and (not folder.is_dir() or any(f.name != _LOCK for f in folder.iterdir())):
        raise RunError(f"{folder}: is not an empty folder and holds no run (no config.json); choose another folder")


def _read_json(path: Path) -> dict[str, Any]:
    try:
        value = json.loads(path.read_text())
    except (OSError, ValueError) as e:
        raise RunError(f"{path}: cannot be read ({e}); choose another folder, or delete it") from e
    if not isinstance(value, dict):
        raise RunError(f"{path}: is not a run's config; choose another folder")
    return value


def read_metrics(folder: Path) -> list[dict[str, Any]]:
    """What a run logged, a record per unit of work: stage, step, seconds, metrics.

    Raises RunError where that is missing or cut.
    """
    path = Path(folder) / "metrics.jsonl"
    try:
        return [json.loads(line) for line in path.read_text().splitlines()]
    except (OSError, ValueError) as e:
        raise RunError(f"{path}: cannot be read ({e}); train again into another folder") from e


def read_config(folder: Path) -> dict[str, Any]:
    """The resolved config of a run. Raises RunError where there is none."""
    path = Path(folder) / "config.json"
    if not path.is_file():
        raise RunError(f"{folder}: holds no run (no config.json); give the folder that `vatmart train` wrote")
    return _read_json(path)


def _plain(x: Any) -> Any:
    return jax.random.key_data(x) if _is_key(x) else jnp.asarray(x)


def _as(kind: Any, value: Any) -> Any:
    return jax.random.wrap_key_data(jnp.asarray(value)) if _is_key(kind) else jnp.asarray(value)


def _is_key(x: Any) -> bool:
    return isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
