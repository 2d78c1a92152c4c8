"""Point clouds, masks and amounts from files and flags."""

from __future__ import annotations

from vatmart_jax.priors.priors import amount, read_cloud, read_mask

__all__ = ["amount", "read_cloud", "read_mask"]
