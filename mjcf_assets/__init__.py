"""Articulated objects made rather than scanned, and the MuJoCo template that every object's Scene is compiled into."""

from __future__ import annotations

from importlib import resources

__all__ = ["scene_template"]


def scene_template() -> str:
    """The MJCF text of the Scene template: object, part, mocap base, hand and fingers, without hulls and gains."""
    return resources.files(__name__).joinpath("scene.xml").read_text()
