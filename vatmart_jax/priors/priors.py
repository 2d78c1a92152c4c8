"""Trained priors: save, load, and predict from a point cloud.

    priors = load_priors("push-door")
    prediction = priors.predict(points, task=0.3)

A folder of priors holds `config.json` and `params.msgpack` (Flax), and needs nothing else.
"""

from __future__ import annotations

import json
import math
import warnings
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import serialization

from vatmart_jax.atomic_io import atomic_directory, atomic_write, write_json
from vatmart_jax.config import from_json, to_json
from vatmart_jax.errors import UserError, require_positive, summarize_error
from vatmart_jax.perception import format_1
from vatmart_jax.perception.config import NetworksConfig
from vatmart_jax.perception.layers import Params
from vatmart_jax.perception.networks import Features, Networks
from vatmart_jax.perception.predictor import TTAPredictor

FORMAT = 2
MAX_AUGMENTATIONS = 64  # of a view: a config is untrusted, and memory grows with them
SMALLEST_BUCKET = 1024


class PriorsError(UserError):
    """A folder of priors is missing, damaged or not what it should be, or an input does not fit the networks."""


@dataclass(frozen=True)
class PriorsConfig:
    """The task and the networks of trained priors. Goals are in rad (hinges) or unit lengths (slides)."""

    task: str
    """name of the task, such as push-door"""
    low: float
    """smallest goal they were trained on"""
    high: float
    """largest goal"""
    networks: NetworksConfig = field(default_factory=NetworksConfig)
    num_augmentations: int = 1
    """copies of a view, mirrored and turned, that predictions are averaged over; 1: the view alone"""

    def __post_init__(self) -> None:
        if not 1 <= self.num_augmentations <= MAX_AUGMENTATIONS:
            raise UserError(f"num_augmentations {self.num_augmentations}: expected 1 to {MAX_AUGMENTATIONS}")


class Prediction(NamedTuple):
    """The priors of one cloud of N points and one task (host arrays)."""

    contact_index: int  # of the point with the highest actionability (on the part, where a mask was given)
    contact: np.ndarray  # [3] float32, that point
    actionability: np.ndarray  # [N] float32 in [0, 1]
    trajectories: np.ndarray  # [P, 30] float32 from that contact, best first; see trajectory.pack_trajectory
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
        """The networks with their test-time augmentation."""
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

        points: [N, 3] partial cloud, object frame (z up, front towards -x, unit lengths). task: goal > 0, rad or
        unit lengths; one outside of the goals in training is warned of. part_mask: [N] bool, restricts the contact to
        these points. key: which points the networks see where the cloud has more than they were trained with, and the
        proposals' randomness; consumed. Compiles once per power of two of N. Raises UserError for input that does not
        fit.
        """
        require_positive("n_proposals", n_proposals)
        points = np.asarray(points, np.float32)
        if points.ndim != 2 or points.shape[1] != 3 or not len(points) or not np.isfinite(points).all():
            raise PriorsError(f"points: expected finite [N, 3] coordinates, found shape {points.shape}")
        if not (math.isfinite(task) and task > 0):
            raise PriorsError(f"task: expected a goal above 0, found {task}")
        mask = np.ones(len(points), bool) if part_mask is None else np.asarray(part_mask, bool)
        if mask.shape != (len(points),) or not mask.any():
            raise PriorsError(f"part_mask: expected {len(points)} booleans, one of them true at least")
        low, high = self.config.low, self.config.high
        if not low * (1 - 1e-3) <= task <= high * (1 + 1e-3):
            warnings.warn(f"task {task:.3g}: the priors were trained on {low:.3g} to {high:.3g}", stacklevel=2)
        padding = _bucket(len(points)) - len(points)
        found = predict(
            self.predictor,
            self.params,
            np.concatenate([points, np.broadcast_to(points[:1], (padding, 3))]),
            np.concatenate([mask, np.zeros(padding, bool)]),
            np.float32(task),
            key=jax.random.key(0) if key is None else key,
            count=np.int32(len(points)),
            n_proposals=n_proposals,
        )
        index, actionability, trajectories, scores = jax.device_get(found)
        return Prediction(int(index), points[int(index)], actionability[: len(points)], trajectories, scores)


@partial(jax.jit, static_argnames=("predictor", "n_proposals"))
def predict(
    predictor: TTAPredictor,
    params: Params,
    points: jax.Array | np.ndarray,
    part_mask: jax.Array | np.ndarray,
    task: jax.Array | np.ndarray,
    *,
    key: jax.Array,
    count: jax.Array | np.ndarray | int,
    n_proposals: int = 100,
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """`Priors.predict` as a function of arrays: contact index [], actionability [N], trajectories [P, 30], scores [P].

    The first `count` of the N points are the cloud, those behind it padding, which part_mask leaves out. Consumes the
    key.
    """
    k_points, k_proposals = jax.random.split(key)
    points, task = jnp.asarray(points), jnp.asarray(task)
    encoder = predictor.networks.encoder
    # Random order for the ball queries, and the number of points that training saw; a smaller cloud repeats.
    order = random_order(k_points, len(points), count)
    seen = points[order[jnp.arange(encoder.num_points) % count]]
    f = predictor.features(params, seen, encoder.prepare(seen, points))
    actionability = predictor.actionability(params, f, points, task)
    contact = jnp.argmax(jnp.where(part_mask, actionability, -1))
    at = Features(*(x[:, contact] for x in f))
    trajectories, scores = predictor.propose_and_score(params, at, points[contact], task, k_proposals, n_proposals)
    best = jnp.argsort(-scores)
    return contact, actionability, trajectories[best], scores[best]


def random_order(key: jax.Array, size: int, count: jax.Array | np.ndarray | int) -> jax.Array:
    """[size] int32, of which the first `count` are those of `jax.random.permutation(key, count)`, without a program for
    each count: random bits do not depend on how many are drawn, and what lies behind the cloud is sorted last."""
    order, behind = jnp.arange(size), jnp.arange(size) >= count
    for number in range(_shuffles(size)):
        key, own = jax.random.split(key)
        bits = jnp.where(behind, jnp.uint32(0xFFFFFFFF), jax.random.bits(own, (size,)))
        shuffled = jax.lax.sort_key_val(bits, order)[1]
        # As many rounds as a cloud of `count` takes; the largest that makes do with `number` of them.
        order = jnp.where(count > _largest(number), shuffled, order)
    return order


def _shuffles(size: int) -> int:
    """Rounds that jax.random.permutation takes."""
    return math.ceil(3 * math.log(max(1, size)) / math.log(2**32 - 1))


def _largest(shuffles: int) -> int:
    """The largest size that takes no more than so many rounds."""
    size = math.floor((2**32 - 1) ** (shuffles / 3))
    return size if _shuffles(size + 1) > shuffles else size + 1


def _bucket(count: int) -> int:
    """The size that clouds of so many points are padded to: a power of two, so that few programs serve all."""
    return max(SMALLEST_BUCKET, 1 << (count - 1).bit_length())


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
    except (OSError, UserError, ValueError, TypeError, KeyError, AttributeError) as e:
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
