"""Constants of the simulation."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PhysicsConfig:
    """Constants of the simulation, chosen by experiment (docs/physics.md). SI units; one unit length is one metre."""

    gripper: str = "panda"
    """a name of GRIPPERS: whose hand it is"""
    timestep: float = 0.004
    """halving it changes the final joint value by under 1 mrad or 1 mm in the median"""
    steps_per_waypoint: int = 100
    """0.4 s; 0.6 s gives the same success of scripted pushes"""
    ramp_fraction: float = 0.7
    """min-jerk over this share of a waypoint, then hold: coasting dies within the hold"""
    iterations: int = 10
    """Newton converges in 5 with the pyramidal cone"""
    ls_iterations: int = 10
    impratio: float = 4.0
    """pyramidal cone, 2 mm slip in a pull; elliptic with 10 needs 50 iterations"""
    friction: float = 2.0
    torsional_friction: float = 0.005
    contact_solref: tuple[float, float] = (0.01, 1.0)
    contact_solimp: tuple[float, float, float] = (0.95, 0.99, 0.001)
    """default contacts and limits are too soft at 60 N on light parts"""
    part_inertia: tuple[float, float] = (0.02, 0.2)
    """joint-space inertia every part is scaled to: hinge (kg m2), slide (kg); density makes 1 to 62 kg of them"""
    part_damping: tuple[float, float] = (2.0, 10.0)
    """hinge (Nms/rad), slide (Ns/m): with the inertia above, coasting dies within hundredths of a second"""
