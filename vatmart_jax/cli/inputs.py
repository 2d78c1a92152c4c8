"""What commands read: point clouds and masks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from vatmart_jax.errors import UserError, summarize_error


def read_cloud(path: Path) -> np.ndarray:
    """Points [N, 3] float32 of a .npy or .ply file. Raises UserError where it holds none."""
    try:
        if path.suffix.lower() == ".npy":
            points = np.load(path, allow_pickle=False)
        elif path.suffix.lower() == ".ply":
            cloud: Any = trimesh.load(path, process=False)
            points = np.asarray(cloud.vertices)
        else:
            raise UserError(f"{path}: expected a .npy or .ply file")
    except UserError:
        raise
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except Exception as e:  # whatever the readers raise on damaged bytes
        raise UserError(f"{path}: cannot be read ({summarize_error(e)})") from e
    if points.dtype.kind not in "fiu" or points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise UserError(f"{path}: expected numbers [N, 3], found {points.dtype} {points.shape}")
    points = points.astype(np.float32)
    if not np.isfinite(points).all():
        raise UserError(f"{path}: holds coordinates that are not finite; remove those points")
    return points


def read_mask(path: Path, count: int) -> np.ndarray:
    """[count] bool of a .npy file. Raises UserError where it holds something else."""
    try:
        mask = np.load(path, allow_pickle=False)
    except (OSError, EOFError, ValueError) as e:
        raise UserError(f"{path}: cannot be read ({summarize_error(e)}); expected a .npy file of booleans") from e
    if mask.shape != (count,) or mask.dtype.kind not in "bui" or not mask.any():
        raise UserError(
            f"{path}: expected {count} booleans, one of them true at least; found {mask.dtype} {mask.shape}"
        )
    return mask.astype(bool)
