"""What a conversion depends on. Functions take only the part they need; the command line has every field as a flag."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from tyro.conf import arg


@dataclass(frozen=True, kw_only=True)
class ReadConfig:
    allow_missing: bool = False
    """Convert objects some of whose meshes are missing, without these and with a note, instead of refusing them."""
    textures: bool = False
    """Carry materials and images of the OBJ files over to model.xml; without, links have colours by role."""
    continuous_range: bool = False
    """Let joints without a limit turn or slide without end, instead of refusing the object."""


@dataclass(frozen=True, kw_only=True)
class DecomposeConfig:
    """All lengths in unit lengths of the object (its extents are 1 to 2)."""

    collision: Literal["hull", "box"] = "hull"
    """Collision geometry: convex hulls, or oriented boxes, which MJX is fast with."""
    part_budget: int = 16
    """Hulls per moving link; in a Scene, of all that moves with its part."""
    static_budget: int = 32
    """Hulls of all that is fixed to the world; in a Scene, of all that stands still."""
    decomposer: Literal["hulls", "coacd"] = "hulls"
    """How concave leaves are taken apart: hulls grown from their flat patches, or CoACD."""
    tolerance: float = 0.015
    """A leaf is one hull where that reaches no farther than this into free space."""
    handle_tolerance: float = 0.008
    """The same for handles, knobs and pulls."""
    merge_tolerance: float = 0.008
    """Hulls merge freely where the result reaches no farther than this into free space."""
    handle_merge_tolerance: float = 0.004
    """The same for handles, knobs and pulls."""
    max_vertices: int = 32
    """Vertices per hull."""
    thickness: float = 0.003
    """Flat leaves are padded to this thickness: MuJoCo refuses coplanar meshes."""


@dataclass(frozen=True, kw_only=True)
class MjcfConfig:
    density: float = 300.0
    """Of the hulls, kg per cubic unit length: what links weigh."""
    friction: float = 1.0
    """Sliding friction of the hulls, towards whatever touches them."""
    joint_damping: float = 1.0
    """Damping of every joint, N m s/rad or N s per unit length."""
    joint_friction: float = 0.05
    """Friction loss of every joint, N m or N."""


@dataclass(frozen=True, kw_only=True)
class ViewConfig:
    """What views are rendered with; changing it leaves converted objects as they are."""

    views: int = 6
    """Views of every Scene for a push task, and as many for a pull task."""
    train_factor: int = 3
    """Training Scenes get so many times as many: the networks overfit to a few views."""
    points: int = 10_000
    """Points per view, as in the paper; in random order, so the first n of them are a view with n points."""
    contacts: int = 128
    """Further pixels of the moving part per view: where a trial may touch."""


@dataclass(frozen=True, kw_only=True)
class ConvertConfig:
    read: Annotated[ReadConfig, arg(name="")] = field(default_factory=ReadConfig)
    decompose: Annotated[DecomposeConfig, arg(name="")] = field(default_factory=DecomposeConfig)
    mjcf: Annotated[MjcfConfig, arg(name="")] = field(default_factory=MjcfConfig)
    view: Annotated[ViewConfig, arg(name="")] = field(default_factory=ViewConfig)
    variants: int = 2
    """Scenes per moving part: all other parts closed, then with some of them open."""
    seed: int = 0
    """Of everything random in the conversion."""
    time_limit: float = 120.0
    """Seconds of processor time per object; one that takes longer is refused, and tried again the next time."""
