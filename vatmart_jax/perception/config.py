"""Sizes of the networks, and how they are trained."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from vatmart_jax.perception.encoder import EncoderConfig
from vatmart_jax.perception.pointnet2 import PointNet2Config


@dataclass(frozen=True)
class NetworksConfig:
    """Sizes of the networks; the defaults are the paper's."""

    encoder: EncoderConfig = field(default_factory=PointNet2Config)
    separate_encoders: bool = False
    """One point cloud encoder for each head, as in the released code, instead of one for all three."""
    contact_dim: int = 32
    """Width of the contact point's feature."""
    task_dim: int = 32
    """Width of the task's feature."""
    absolute_waypoints: bool = True
    """The trajectory encoder also reads the fingertips' waypoints: residuals summed up. The paper's does not."""
    trajectory_hidden: tuple[int, ...] = (128, 128, 128)
    """Widths of the trajectory encoder."""
    latent_dim: int = 128
    """Dimensions of the cVAE's Gaussian."""
    posterior_hidden: tuple[int, ...] = (128, 128)
    """Hidden widths of the cVAE's encoder."""
    decoder_hidden: tuple[int, ...] = (512, 256)
    """Hidden widths of the cVAE's decoder."""
    scorer_hidden: tuple[int, ...] = (128,)
    """Hidden widths of the trajectory scoring head."""
    actionability_hidden: tuple[int, ...] = (128, 128, 128, 128)
    """Hidden widths of the actionability head."""
    flow_hidden: tuple[int, ...] = ()
    """Hidden widths of a head that predicts the articulation flow of the contact point; the other heads read its
    prediction. Empty: no such head, as in the paper."""
    predict_axis: bool = False
    """The flow of a hinged part is an arc: its head predicts the joint axis, the rest is geometry. Slides have none."""
    gripper_patch_hidden: tuple[int, ...] = ()
    """Widths of a network over the points around the contact in the initial gripper frame, which the scorer reads: what
    the fingers would close on or run into. Empty: none, as in the paper."""
    extra_heads: tuple[str, ...] = ()
    """Further heads by their names in the registry HEADS; those of plugins."""

    def __post_init__(self) -> None:
        if self.flow_hidden and self.separate_encoders:
            raise ValueError("the flow head needs the shared encoder: leave out flow_hidden or separate_encoders")
        if self.predict_axis and not self.flow_hidden:
            raise ValueError("predict_axis is of the flow head: give flow_hidden its widths, or leave out predict_axis")
        if self.gripper_patch_hidden and not self.encoder.build().num_local_points:
            raise ValueError(
                "the gripper patch reads the encoder's local groups: give encoder.local_groups some, or leave out "
                "gripper_patch_hidden"
            )


def for_task(networks: NetworksConfig, slides: bool) -> NetworksConfig:
    """The networks of a task whose part slides, or turns: a slide has no axis to predict."""
    return replace(networks, predict_axis=networks.predict_axis and not slides)


@dataclass(frozen=True)
class TaskSpec:
    """What labels and augmentation need to know of a task. Goals are in rad (hinges) or unit lengths (slides)."""

    goal_range: tuple[float, float]
    """smallest and largest goal"""
    tolerance: float
    """success: the part moved by the goal within this fraction of it"""
    relabel_range: float
    """the scorer's negatives have goals off by up to this much"""
    slides: bool
    """goals are lengths, which grow with the scene; parts move along their axis and do not turn"""


@dataclass(frozen=True)
class AugmentationConfig:
    """Random transforms of a view with all that happens in it."""

    yaw: float = 0.25
    """views turn about the vertical by up to this much (rad), either way"""
    mirror: bool = True
    """half of the views are mirrored left to right"""
    scale: float = 0.2
    """views grow or shrink by up to this fraction"""


@dataclass(frozen=True)
class PerceptionConfig:
    """How the networks are trained."""

    networks: NetworksConfig = field(default_factory=NetworksConfig)
    augmentation: AugmentationConfig = field(default_factory=AugmentationConfig)
    views_per_batch: int = 8
    """views per step"""
    samples_per_view: int = 48
    """samples per view and step"""
    actionability_queries: int = 16
    """random contacts per view and step, for actionability; at most `samples_per_view`"""
    num_proposals: int = 100
    """trajectories proposed at such a contact"""
    top_k: int = 5
    """the actionability target is the mean score of so many best proposals"""
    proposal_fraction: float = 0.5
    """fraction of a view's samples that are of the networks' own proposals, where it has both kinds"""
    relabel_fraction: float = 0.5
    """fraction of the scorer's rows whose goal is what the trajectory achieved, within the tolerance"""
    negative_fraction: float = 0.3
    """fraction whose goal is shifted off that; the rest keep the commanded goal, failed starts and grasps among them"""
    learning_rate: float = 2e-3
    """after 100 steps of warm-up; falls along a cosine to a fiftieth at the stage's end"""
    encoder_lr_scale: float = 1.0
    """factor on that for encoder and flow head, where there is one, in the stages `scorer` and `proposal`, whose fresh
    heads undo some of what a long `flow` stage has learned"""
    muon: bool = True
    """Muon for all matrices: their momentum made orthogonal, at the size of Adam's steps; the paper has Adam"""
    weight_decay: float = 1e-4
    """decoupled, as in AdamW"""
    score_weight: float = 5.0
    """of the scorer's cross-entropy"""
    position_weight: float = 50.0
    """of the L1 of waypoint positions, per unit length"""
    euler_weight: float = 50.0
    """of the L1 of waypoint Euler residuals, per rad"""
    rotation_weight: float = 5.0
    """of the squared 6D distance of start rotations"""
    kl_weight: float = 1.0
    """of the KL divergence; at 0.05 the decoder's samples ignore contact and task"""
    free_bits: float = 6.0
    """nats of it that cost nothing, so that the posterior does not collapse before the decoder uses the latent"""
    flow_weight: float = 50.0
    """of the L1 of the contact's articulation flow, and of its joint axis where the networks predict it"""
    flow_noise: float = 0.15
    """the scorer is trained on flows perturbed by about this fraction, as they are off on unseen objects"""
    actionability_weight: float = 5.0
    """of the L1 of actionability"""
    log_every: int = 50
    """steps between two reports"""

    def __post_init__(self) -> None:
        if self.actionability_queries > self.samples_per_view:
            raise ValueError(
                f"actionability_queries ({self.actionability_queries}) must not exceed samples_per_view "
                f"({self.samples_per_view})"
            )
