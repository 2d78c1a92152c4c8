"""What commands read: goals with units, clouds and masks; what is none is refused in one line."""

from pathlib import Path

import numpy as np
import pytest

from vatmart_jax.cli.inputs import read_cloud, read_mask
from vatmart_jax.errors import UserError


@pytest.mark.parametrize(
    "name, content, message",
    [
        ("cloud.npy", np.zeros((5, 2)), r"expected numbers \[N, 3\], found float64 \(5, 2\)"),
        ("cloud.npy", np.full((5, 3), np.nan), "not finite"),
        ("cloud.npy", np.array([{"a": 1}]), "cannot be read"),
        ("cloud.txt", np.zeros((5, 3)), "expected a .npy or .ply file"),
    ],
)
def test_a_cloud_that_is_none_is_refused(tmp_path: Path, name: str, content: np.ndarray, message: str) -> None:
    with (tmp_path / name).open("wb") as f:
        np.save(f, content, allow_pickle=True)
    with pytest.raises(UserError, match=message):
        read_cloud(tmp_path / name)


def test_a_mask_of_another_size_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "mask.npy", np.ones(5, bool))
    with pytest.raises(UserError, match="expected 6 booleans"):
        read_mask(tmp_path / "mask.npy", 6)
