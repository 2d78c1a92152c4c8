"""Grouped views belong to the views they were made of, whatever the size of the last batch."""

import jax
import numpy as np
import pytest
from synthetic import boxes

from vatmart_jax.errors import UserError
from vatmart_jax.perception.grouped_views import group_views
from vatmart_jax.perception.pointnet2 import PointNet2Config, SetAbstraction

TINY = PointNet2Config(
    n_points=64, levels=(SetAbstraction(16, 0.3, 8, (16,)), SetAbstraction(4, 0.8, 4, (16,))), propagation=((16,),) * 2
)


def test_views_of_another_split_are_refused(cabinets) -> None:
    views = cabinets[1]
    config = PointNet2Config(n_points=64, levels=TINY.levels, propagation=TINY.propagation)
    grouped_views = group_views(views, config)
    grouped_views.check_same_views(views)
    others = views.select(np.arange(len(views))[::-1])
    with pytest.raises(ValueError, match=r"the grouped views .* are not the environment's"):
        grouped_views.check_same_views(others)
    fewer = views.select(np.arange(len(views) - 1))
    with pytest.raises(ValueError, match="are not the environment's"):
        grouped_views.check_same_views(fewer)


def test_views_with_too_few_points_are_refused(cabinets) -> None:
    with pytest.raises(UserError, match="convert again with 100000 points"):
        group_views(cabinets[1], PointNet2Config(n_points=100_000))


def test_a_view_is_prepared_as_it_would_be_alone() -> None:
    many, one = boxes(0, 18, TINY, contacts=8)[0], boxes(0, 1, TINY, contacts=8)[0]
    for a, b in zip(jax.tree.leaves(many.prepared), jax.tree.leaves(one.prepared), strict=True):
        np.testing.assert_array_equal(a[0], b[0])
    assert len(many) == 18 and int(many.fingerprint) != int(one.fingerprint)
