"""Priors for use elsewhere: a Flax checkpoint that stands alone, and StableHLO that needs no Python code of ours."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
from jax import export as jax_export

from vatmart_jax.atomic_io import atomic_directory, write_json
from vatmart_jax.config import to_json
from vatmart_jax.errors import require_one_of, require_positive
from vatmart_jax.priors.priors import Priors, predict

FORMATS = ("flax", "stablehlo")
PLATFORMS = ("cpu", "cuda")


def export(priors: Priors, out: Path | str, formats: Sequence[str] = FORMATS, n_proposals: int = 100) -> list[Path]:
    """Write the priors into folder `out`, one subfolder per format; returns the files.

    `flax/` loads with `Priors.load`. `stablehlo/priors.bin` loads with `jax.export.deserialize` (any StableHLO runtime
    for the module within) and is one function, parameters included; `stablehlo/signature.json` names what goes in and
    comes out. Raises UserError for an unknown format or no proposals, before anything is written.
    """
    for name in formats:
        require_one_of("format", name, FORMATS)
    require_positive("n_proposals", n_proposals)
    out = Path(out)
    for name in formats:
        if name == "flax":
            priors.save(out / "flax")
        else:
            _save_stablehlo(priors, out / "stablehlo", n_proposals)
    return sorted(file for name in formats for file in (out / name).iterdir())


def _save_stablehlo(priors: Priors, folder: Path, n_proposals: int) -> None:
    n = priors.predictor.networks.encoder.num_points

    def function(points: jax.Array, part_mask: jax.Array, task: jax.Array, seed: jax.Array) -> tuple[jax.Array, ...]:
        return predict(
            priors.predictor, priors.params, points, part_mask, task,
            key=jax.random.key(seed), count=n, n_proposals=n_proposals,
        )  # fmt: skip

    inputs = {
        "points": jax.ShapeDtypeStruct((n, 3), jnp.float32),
        "part_mask": jax.ShapeDtypeStruct((n,), jnp.bool_),
        "task": jax.ShapeDtypeStruct((), jnp.float32),
        "seed": jax.ShapeDtypeStruct((), jnp.uint32),
    }
    exported = jax_export.export(jax.jit(function), platforms=PLATFORMS)(*inputs.values())
    names = ("contact_index", "actionability", "trajectories", "scores")
    outputs = dict(zip(names, exported.out_avals, strict=True))
    describe = lambda of: {k: {"shape": list(v.shape), "dtype": v.dtype.name} for k, v in of.items()}
    signature = {"inputs": describe(inputs), "outputs": describe(outputs), "platforms": list(PLATFORMS)}
    with atomic_directory(folder) as part:
        (part / "priors.bin").write_bytes(exported.serialize())
        write_json(part / "signature.json", signature | to_json(priors.config))
