"""What version 0.1 called the fields of its configs and the parameters of its networks (format 1)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_ENCODER = {"n_points": "n_points", "around": "local_groups", "context": "global_context"}
_LEVEL = {"centroids": "num_centroids", "neighbours": "max_neighbors"}
_NETWORKS = {
    "pointnet": "encoder", "separate": "separate_encoders", "positions": "absolute_waypoints", "course": "flow_hidden",
    "hinge": "predict_axis", "hand": "gripper_patch_hidden", "trajectory": "trajectory_hidden",
    "posterior": "posterior_hidden", "decoder": "decoder_hidden", "scorer": "scorer_hidden",
    "actionability": "actionability_hidden",
}  # fmt: skip
_AUGMENTATION = ("yaw", "mirror", "scale")
_PARAMETERS = {"course": "flow"}


def renamed(config: Mapping[str, Any], names: Mapping[str, str]) -> dict[str, Any]:
    """The config's fields under their names of format 2; those that `names` leaves out keep theirs."""
    return {names.get(name, name): value for name, value in config.items()}


def networks_config(config: Mapping[str, Any]) -> dict[str, Any]:
    """A NetworksConfig of format 1, as JSON has it, in format 2."""
    out = renamed(config, _NETWORKS)
    encoder = renamed(out["encoder"], _ENCODER)
    for groups in ("levels", "local_groups"):
        encoder[groups] = [renamed(level, _LEVEL) for level in encoder[groups]]
    return out | {"encoder": encoder}


def grouped_augmentation(config: Mapping[str, Any]) -> dict[str, Any]:
    """A PerceptionConfig whose fields of augmentation lay beside the others, with these in `augmentation`."""
    own = {name: value for name, value in config.items() if name in _AUGMENTATION}
    return {name: value for name, value in config.items() if name not in own} | {"augmentation": own}


def parameters(tree: Any) -> Any:
    """Parameters of the networks, or what an optimiser keeps of them, under their names of format 2."""
    if not isinstance(tree, Mapping):
        return tree
    return {_PARAMETERS.get(name, name): parameters(value) for name, value in tree.items()}
