"""One camera for views, previews and pictures of priors."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from conversion.render_views import DISTANCE, FIELD_OF_VIEW, PIXELS
from vatmart_jax.camera import Camera
from vatmart_jax.viz import plots

RNG = np.random.default_rng(0)
ANGLES = [(float(RNG.uniform(-np.pi, np.pi)), float(RNG.uniform(-1.2, 1.2))) for _ in range(20)]


@pytest.mark.parametrize(("azimuth", "elevation"), ANGLES)
def test_a_camera_stands_where_its_angles_say_and_looks_at_the_centre(azimuth, elevation):
    centre = np.array([0.3, -0.2, 0.1])
    camera = Camera.looking_at(centre, azimuth, elevation, 2.0)
    back = [-np.cos(azimuth) * np.cos(elevation), -np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
    np.testing.assert_allclose(camera.position - centre, 2 * np.array(back), atol=1e-12)
    np.testing.assert_allclose(camera.axes @ camera.axes.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.cross(camera.right, camera.up), -camera.forward, atol=1e-12)
    assert camera.up[2] > 0
    np.testing.assert_allclose(camera.project(centre), 0, atol=1e-12)
    assert camera.depth(centre) == pytest.approx(2)


def test_pictures_of_priors_are_drawn_from_the_camera_of_the_view(cabinets, monkeypatch, tmp_path):
    """What is drawn is the cloud as the camera that took the view projects it, not its mirror image."""
    views = cabinets[1]
    drawn = []
    monkeypatch.setattr(Axes, "scatter", lambda axis, x, y, **_: drawn.append(np.stack([x, y], -1)))
    monkeypatch.setattr(Figure, "colorbar", lambda *_, **__: None)
    for view in range(4):
        points, mask = views.points[view].astype(float), views.part_mask[view]
        drawn.clear()
        plots.priors_figure(
            tmp_path / "priors.png", points=points, part_mask=mask, actionability=np.zeros(len(points)),
            contact=points[0], trajectories=np.zeros((0, 30)), scores=np.zeros(0), camera=views.camera(view), title="",
            standoff=0.02,
        )  # fmt: skip
        want = Camera.looking_at(np.zeros(3), float(views.azimuth[view]), float(views.elevation[view]), DISTANCE)
        flat = (points[mask] @ want.axes[:2].T).round(6)
        assert sorted(map(tuple, drawn[1].round(6))) == sorted(map(tuple, flat))


def test_rays_go_through_what_they_are_cast_for():
    camera = Camera.looking_at(np.zeros(3), 0.4, 0.7, DISTANCE)
    points = RNG.uniform(-0.5, 0.5, (50, 3))
    rays = camera.rays(points, pixels=PIXELS, field_of_view=FIELD_OF_VIEW)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1, atol=1e-12)
    towards = (points - camera.position) / np.linalg.norm(points - camera.position, axis=1, keepdims=True)
    pixel = FIELD_OF_VIEW / PIXELS
    assert (np.arccos(np.clip(towards @ rays.T, -1, 1)).min(axis=1) < pixel).all()
