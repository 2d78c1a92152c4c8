"""Articulated objects made rather than scanned, and the MuJoCo template that every object's Scene is compiled into."""

from __future__ import annotations

from importlib import resources

__all__ = ["gripper_mjcf", "scene_template"]


def scene_template() -> str:
    """The MJCF text of the Scene template: object, part and the gripper's mocap base; no hulls, no gripper."""
    return resources.files(__name__).joinpath("scene.xml").read_text()


def gripper_mjcf(file: str) -> str:
    """The MJCF text of a gripper of `grippers/`: one body, at its flange, with a slide per finger; no gains."""
    return resources.files(__name__).joinpath("grippers", file).read_text()
