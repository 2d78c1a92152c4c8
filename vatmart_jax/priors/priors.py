"""Trained priors: save, load, and predict from a point cloud.

    priors = Priors.load("run")
    prediction = priors.predict(points, task=0.3)

A folder of priors holds `config.json` and `params.msgpack` (Flax), and needs nothing else.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from flax import serialization

from vatmart_jax.atomic_io import atomic_directory, atomic_write, write_json
from vatmart_jax.config import from_json, to_json
from vatmart_jax.errors import UserError, require_positive, summarize_error
from vatmart_jax.perception import format_1
from vatmart_jax.perception.networks import Features, Networks, NetworksConfig, Params
from vatmart_jax.perception.pointnet2 import group
from vatmart_jax.perception.predictor import TTAPredictor

FORMAT = 2
MAX_AUGMENTATIONS = 64  # of a view: a config is untrusted, and memory grows with them


class PriorsError(UserError):
    """A folder of priors is missing, damaged or not what it should be, or an input does not fit the networks."""


@dataclass(frozen=True)
class PriorsConfig:
    """What the priors are of. Amounts are in rad (doors) or unit lengths (drawers)."""

    task: str
    """push-door, pull-door, push-drawer or pull-drawer"""
    low: float
    """smallest amount they were trained on"""
    high: float
    """largest amount"""
    networks: NetworksConfig = field(default_factory=NetworksConfig)
    num_augmentations: int = 1
    """of a view, mirrored and turned, that the networks are asked about; 1: the view alone"""

    def __post_init__(self) -> None:
        if not 1 <= self.num_augmentations <= MAX_AUGMENTATIONS:
            raise UserError(f"num_augmentations {self.num_augmentations}: expected 1 to {MAX_AUGMENTATIONS}")


class Prediction(NamedTuple):
    """The priors of one cloud of N points and one task (host arrays)."""

    contact_index: int  # of the point with the highest actionability (on the part, where a mask was given)
    contact: np.ndarray  # [3] float32, that point
    actionability: np.ndarray  # [N] float32 in [0, 1]
    trajectories: np.ndarray  # [P, 30] float32 from that contact, best first; see geometry.pack_trajectory
    scores: np.ndarray  # [P] float32 in [0, 1], falling

    def save(self, path: Path | str) -> None:
        """Write one .npz file with these fields, complete or not at all."""
        with atomic_write(path) as part, part.open("wb") as f:
            np.savez(f, **self._asdict())


@dataclass(frozen=True)
class Priors:
    """Networks and their parameters."""

    config: PriorsConfig
    params: Params

    @property
    def predictor(self) -> TTAPredictor:
        """The networks as they are to be asked."""
        return TTAPredictor(Networks(self.config.networks), self.config.num_augmentations)

    def save(self, path: Path | str) -> None:
        """Write the folder, complete or not at all; one that is there is replaced."""
        with atomic_directory(path) as part:
            (part / "params.msgpack").write_bytes(serialization.msgpack_serialize(jax.device_get(self.params)))
            write_json(part / "config.json", {"format": FORMAT, **to_json(self.config)})

    @classmethod
    def load(cls, path: Path | str) -> Priors:
        """From a folder of priors, or from a run folder, which has them in priors/.

        Raises PriorsError where the folder is missing, damaged, or holds other networks than its config says.
        """
        path = Path(path)
        path = path / "priors" if (path / "priors").is_dir() else path
        config, written = _read_config(path / "config.json")
        file = path / "params.msgpack"
        try:
            params: Any = serialization.msgpack_restore(file.read_bytes())
        except Exception as e:  # whatever msgpack and NumPy raise on damaged bytes
            raise PriorsError(f"{file}: cannot be read ({summarize_error(e)}); train or export the priors again") from e
        if written == 1:
            params = format_1.parameters(params)
        expected = jax.eval_shape(Networks(config.networks).init, jax.random.key(0))
        wrong = _difference(expected, params)
        if wrong:
            raise PriorsError(f"{file}: {wrong}; it does not belong to {path / 'config.json'}, export the priors again")
        return cls(config, jax.tree.map(jnp.asarray, params))

    def predict(
        self,
        points: np.ndarray,
        task: float,
        part_mask: np.ndarray | None = None,
        key: jax.Array | None = None,
        n_proposals: int = 100,
    ) -> Prediction:
        """Actionability of every point, and trajectories at the best of them.

        points: [N, 3] partial cloud, object frame (z up, front towards -x, unit lengths). task: amount > 0, rad or
        unit lengths. part_mask: [N] bool, restricts the contact to these points. key: which points the networks see
        where the cloud has more than they were trained with, and the proposals' randomness; consumed. Raises
        UserError for input that does not fit.
        """
        require_positive("--proposals", n_proposals)
        points = np.asarray(points, np.float32)
        if points.ndim != 2 or points.shape[1] != 3 or not len(points) or not np.isfinite(points).all():
            raise PriorsError(f"points: expected finite [N, 3] coordinates, found shape {points.shape}")
        if not (math.isfinite(task) and task > 0):
            raise PriorsError(f"task: expected an amount above 0, found {task}")
        mask = np.ones(len(points), bool) if part_mask is None else np.asarray(part_mask, bool)
        if mask.shape != (len(points),) or not mask.any():
            raise PriorsError(f"part_mask: expected {len(points)} booleans, one of them true at least")
        found = predict(
            self.predictor, self.params, points, mask, jnp.float32(task), jax.random.key(0) if key is None else key,
            n_proposals,
        )  # fmt: skip
        index, *rest = jax.device_get(found)
        return Prediction(int(index), points[int(index)], *rest)


@partial(jax.jit, static_argnames=("predictor", "n_proposals"))
def predict(
    predictor: TTAPredictor,
    params: Params,
    points: jax.Array | np.ndarray,
    part_mask: jax.Array | np.ndarray,
    task: jax.Array,
    key: jax.Array,
    n_proposals: int = 100,
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """`Priors.predict` as a function of arrays: contact index [], actionability [N], trajectories [P, 30], scores [P].

    Consumes the key.
    """
    k_points, k_proposals = jax.random.split(key)
    points = jnp.asarray(points)
    encoder = predictor.networks.config.encoder
    # Random order for the ball queries, and the number of points that training saw; a smaller cloud repeats.
    order = jax.random.permutation(k_points, len(points))
    seen = points[jnp.resize(order, (encoder.n_points,))]
    f = predictor.features(params, seen, group(seen, points, encoder))
    actionability = predictor.actionability(params, f, points, task)
    contact = jnp.argmax(jnp.where(part_mask, actionability, -1))
    at = Features(*(x[:, contact] for x in f))
    trajectories, scores = predictor.propose(params, at, points[contact], task, k_proposals, n_proposals)
    best = jnp.argsort(-scores)
    return contact, actionability, trajectories[best], scores[best]


def read_cloud(path: Path) -> np.ndarray:
    """Points [N, 3] float32 of a .npy or .ply file. Raises PriorsError where it holds none."""
    try:
        if path.suffix.lower() == ".npy":
            points = np.load(path, allow_pickle=False)
        elif path.suffix.lower() == ".ply":
            points = np.asarray(trimesh.load(path, process=False).vertices)
        else:
            raise PriorsError(f"{path}: expected a .npy or .ply file")
    except PriorsError:
        raise
    except FileNotFoundError:
        raise PriorsError(f"{path}: no such file") from None
    except Exception as e:  # whatever the readers raise on damaged bytes
        raise PriorsError(f"{path}: cannot be read ({summarize_error(e)})") from e
    if points.dtype.kind not in "fiu" or points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise PriorsError(f"{path}: expected numbers [N, 3], found {points.dtype} {points.shape}")
    points = points.astype(np.float32)
    if not np.isfinite(points).all():
        raise PriorsError(f"{path}: holds coordinates that are not finite; remove those points")
    return points


def read_mask(path: Path, count: int) -> np.ndarray:
    """[count] bool of a .npy file. Raises PriorsError where it holds something else."""
    try:
        mask = np.load(path, allow_pickle=False)
    except (OSError, EOFError, ValueError) as e:
        raise PriorsError(f"{path}: cannot be read ({summarize_error(e)}); expected a .npy file of booleans") from e
    if mask.shape != (count,) or mask.dtype.kind not in "bui" or not mask.any():
        raise PriorsError(
            f"{path}: expected {count} booleans, one of them true at least; found {mask.dtype} {mask.shape}"
        )
    return mask.astype(bool)


def amount(text: str, task: str) -> float:
    """Rad or unit lengths from `30deg`, `0.5rad` or a plain number of the task's unit. Raises PriorsError."""
    door = task.endswith("door")
    number, unit = text, ""
    for suffix in ("deg", "rad"):
        if text.endswith(suffix):
            number, unit = text[: -len(suffix)], suffix
    try:
        value = float(number)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0) or (unit and not door):
        example = "30deg or 0.5rad" if door else "0.3 (unit lengths)"
        raise PriorsError(f"--task {text}: expected an amount above 0 such as {example}, for the priors are of {task}")
    return math.radians(value) if unit == "deg" else value


def _read_config(path: Path) -> tuple[PriorsConfig, int]:
    """The config, and the number of the format it was written in."""
    if not path.is_file():
        raise PriorsError(f"{path}: no such file; expected a folder of priors such as RUN/priors of `vatmart train`")
    try:
        found = json.loads(path.read_text())
        written = found.pop("format", None) if isinstance(found, dict) else None
        if written not in (1, FORMAT):
            raise ValueError(f"not of format {FORMAT}")
        if written == 1:
            found = format_1.renamed(found, {"copies": "num_augmentations"})
            found["networks"] = format_1.networks_config(found["networks"])
        return from_json(PriorsConfig, found), written
    except (UserError, OSError, ValueError, TypeError, KeyError, AttributeError) as e:
        raise PriorsError(f"{path}: not a config of priors ({summarize_error(e)}); train or export them again") from e


def _difference(expected: Any, found: Any) -> str:
    """What is wrong with the parameters, or nothing."""
    if not isinstance(found, dict):
        return "holds no parameters"
    flat = lambda tree: {jax.tree_util.keystr(k): v for k, v in jax.tree_util.tree_leaves_with_path(tree)}
    expected, found = flat(expected), flat(found)
    for name in sorted(expected.keys() ^ found.keys()):
        return f"parameter {name} is {'missing' if name in expected else 'unknown'}"
    for name, value in found.items():
        if not isinstance(value, np.ndarray) or value.shape != expected[name].shape or value.dtype != np.float32:
            return f"parameter {name}: expected float32 {expected[name].shape}, found {getattr(value, 'shape', value)}"
        if not np.isfinite(value).all():
            return f"parameter {name} is not finite"
    return ""
