"""All that a run carries from stage to stage."""

from __future__ import annotations

import jax
from flax import struct

from vatmart_jax.perception.trainer import Interactions, PerceptionState
from vatmart_jax.pipeline.exploration import ExplorationState


class TrainState(struct.PyTreeNode, kw_only=True):
    """A pytree of arrays, so that a checkpoint of it resumes bit for bit. S stages."""

    explore: ExplorationState
    perception: PerceptionState
    samples: Interactions
    stored: jax.Array  # [] int32, samples ever
    stage: jax.Array  # [] int32, index into the run's stages
    done: jax.Array  # [] int32, units of that stage
    seconds: jax.Array  # [S + 1] spent per stage and, last, compiling; restarts included

    def with_samples(self, new: Interactions) -> TrainState:
        """Trials stored, in place of the oldest where the buffer is full."""
        return self.replace(samples=self.samples.insert(new, self.stored), stored=self.stored + len(new.view))
