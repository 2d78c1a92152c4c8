"""Which moving links of an object are doors, drawers and lids, where each is closed and which way it opens."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from conversion.model import ArticulatedObject, Joint, Part
from conversion.raycast import meets_any

MIN_SWING = np.deg2rad(10)  # a joint that travels less is no task
MIN_SLIDE = 0.1
# Links whose semantics say so are lids in these categories; a lid elsewhere (a washing machine's) is a door.
LID_CATEGORIES = ("Box",)
LID_MARGIN = 0.1  # a closed lid may stick out of the body this far, unit lengths
LEVEL = np.deg2rad(20)  # a closed lid lies this flat, and its hinge is this horizontal

# Links that move but are neither door nor drawer, by their own semantics or because all their visuals are such.
SMALL_WORDS = (
    "handle", "knob", "button", "switch", "wheel", "caster", "tray", "lock", "lever", "latch", "buckle", "movable_part",
)  # fmt: skip
OTHER_WORDS = ("shelf", "rack", "board", "key", "pedal", "leg", "seat", "fan", "blade", "screw", "slider", "screen")


def detect_parts(obj: ArticulatedObject) -> tuple[list[Part], list[tuple[str, str]]]:
    """The doors, drawers and lids of an object, and every other moving joint with the reason why it is none."""
    found, left_out = [], []
    size = max(np.ptp(_posed(obj, obj.links).reshape(-1, 3), axis=0).max(), 1e-9)
    for link, joint in obj.joints.items():
        if joint.type == "fixed":
            continue
        if reason := _no_part(obj, joint, size):
            left_out.append((joint.name, reason))
            continue
        if _is_lid(obj, joint):
            kind, way = "lid", _lid_motion(obj, joint)
            if isinstance(way, str):
                left_out.append((joint.name, way))
                continue
            closed, sign = way
        else:
            kind, closed = "drawer" if joint.type == "prismatic" else "door", _closed_value(obj, joint)
            sign = 1 if joint.upper - closed >= closed - joint.lower else -1
        joint_range = float(joint.upper - closed if sign > 0 else closed - joint.lower)
        found.append(Part(joint=joint.name, link=link, kind=kind, closed=closed, sign=sign, joint_range=joint_range))
    return found, left_out


def _no_part(obj: ArticulatedObject, joint: Joint, size: float) -> str:
    """Why this joint is neither door nor drawer; empty where it is one. size: the object's largest extent."""
    link = obj.links[joint.child]
    visuals = obj.group_visuals(joint.child)
    if not visuals:
        return "nothing visible moves"
    if not joint.limited:
        return "turns without end"
    label = link.semantics.lower()
    if word := next((w for w in SMALL_WORDS + OTHER_WORDS if w in label), None):
        return f"is a {word}"
    names = {re.sub(r"[-_]?\d+$", "", v.name).lower() for v in link.visuals}
    if names and all(any(w in n for w in SMALL_WORDS) for n in names):
        return f"consists of {', '.join(sorted(names))}"
    shortest = MIN_SLIDE if joint.type == "prismatic" else MIN_SWING
    if joint.upper - joint.lower < shortest:
        return f"travels only {joint.upper - joint.lower:.3g}"
    extent = np.sort(np.ptp(np.concatenate([v.vertices for v in visuals]), axis=0))
    if extent[2] < 0.12 * size or extent[1] < 0.04 * size:
        return f"is small ({extent[2]:.2g} by {extent[1]:.2g})"
    return ""


def _is_lid(obj: ArticulatedObject, joint: Joint) -> bool:
    label = re.split("[^a-z]+", obj.links[joint.child].semantics.lower())
    return joint.type == "revolute" and obj.category in LID_CATEGORIES and "lid" in label


def _lid_motion(obj: ArticulatedObject, joint: Joint) -> tuple[float, int] | str:
    """The joint value at which a lid is closed and the sign that opens it, or why it is no lid.

    The elevation of its free edge, seen from the hinge, grows linearly with the joint value. Closed is where the edge
    is level and over the body: at an end of the range or at 0 where one of them is nearly so. Opening raises the edge.
    """
    if obj.group_root(joint.parent) != obj.root:
        return "hangs on a part that moves itself"
    pose = obj.link_poses()[joint.parent] @ joint.origin
    axis, hinge = pose[:3, :3] @ joint.axis, pose[:3, 3]
    if abs(axis[2]) > np.sin(LEVEL):
        return "is a lid whose hinge is not horizontal"
    corners = np.concatenate([v.vertices for v in obj.group_visuals(joint.child)])
    arms = corners @ pose[:3, :3].T  # from the hinge, at joint value 0
    up = np.array([0.0, 0.0, 1.0]) - axis[2] * axis
    up /= np.linalg.norm(up)
    across = np.cross(up, axis)
    reach = np.hypot(arms @ across, arms @ up)
    free = arms[reach > 0.9 * reach.max()].mean(axis=0)
    body = _posed(obj, obj.groups[obj.root]).reshape(-1, 3)
    low, high = body.min(axis=0)[:2] - LID_MARGIN, body.max(axis=0)[:2] + LID_MARGIN

    def turned(value: float) -> np.ndarray:
        return hinge + arms @ Rotation.from_rotvec(value * axis).as_matrix().T

    found = []  # share over the body, closed value, sign
    for inward in (across, -across):
        elevation = np.arctan2(free @ up, free @ inward)
        sign = 1 if np.cross(axis, inward) @ up > 0 else -1
        closed = _level_value(joint, float(elevation), sign)
        if closed is None:
            continue
        over = ((turned(closed)[:, :2] >= low) & (turned(closed)[:, :2] <= high)).all(axis=1).mean()
        found.append((float(over), closed, sign))
    if not found:
        return "is a lid that lies level nowhere in its range"
    over, closed, sign = max(found, key=lambda f: f[0])
    room = joint.upper - closed if sign > 0 else closed - joint.lower
    if over < 0.5:
        return "is a lid that does not lie on the body"
    return (closed, sign) if room >= MIN_SWING else f"is a lid that opens only {room:.3g}"


def _level_value(joint: Joint, elevation: float, sign: int) -> float | None:
    """The joint value at which elevation + sign * value is 0 (rad, modulo turns), or an end or 0 where it nearly is."""
    ends = sorted((v for v in {joint.lower, joint.upper, 0.0} if joint.lower <= v <= joint.upper), key=abs)
    tilt = [abs((elevation + sign * v + np.pi) % (2 * np.pi) - np.pi) for v in ends]
    if min(tilt) <= LEVEL:
        return ends[int(np.argmin(tilt))]
    turns = np.arange(-2, 3) * 2 * np.pi
    level = [v for v in (sign * (turns - elevation)).tolist() if joint.lower <= v <= joint.upper]
    return min(level, key=abs, default=None)


def _posed(obj: ArticulatedObject, links: Iterable[str], values: Mapping[str, float] | None = None) -> np.ndarray:
    """Triangles [m, 3, 3] of links in the object frame."""
    poses = obj.link_poses(values)
    triangles = [
        (v.vertices @ poses[name][:3, :3].T + poses[name][:3, 3])[v.faces]
        for name in links
        for v in obj.links[name].visuals
    ]
    return np.concatenate([np.zeros((0, 3, 3)), *triangles])


def _closed_value(obj: ArticulatedObject, joint: Joint) -> float:
    """The joint value at which the part is closed.

    That is where it is least off the hull of what it is mounted on and, of the values at which it hardly is (a flap
    can also hang down outside), where it covers most of the way from inside to outside. The dataset models
    most objects closed, at 0: where that is an end of the range, the other end must be closed much better.
    """
    zero = float(np.clip(0.0, joint.lower, joint.upper))
    at_end = min(zero - joint.lower, joint.upper - zero) <= 1e-3 * (joint.upper - joint.lower)
    candidates = sorted({joint.lower, joint.upper} if at_end else {joint.lower, joint.upper, zero}, key=abs)
    moving = obj.subtree(joint.child)
    # What it hangs on and the static group: other drawers may be ajar as well.
    carriers, link = {obj.root}, joint.parent
    while link in obj.joints:
        link = obj.group_root(link)
        carriers.add(link)
        link = obj.joints[link].parent if link in obj.joints else link
    rest = _posed(obj, [n for n in obj.links if obj.group_root(n) in carriers and n not in moving])
    try:
        equations = ConvexHull(rest.reshape(-1, 3)).equations
    except (QhullError, ValueError):
        return candidates[0]
    own = obj.groups[joint.child]
    posed = [_posed(obj, own, {joint.name: value}) for value in candidates]
    size = np.ptp(rest.reshape(-1, 3), axis=0).max()
    depths = [_depth(equations, p.reshape(-1, 3)) for p in posed]
    # A drawer belongs inside the hull, a door on it: it may also swing inwards.
    off = [np.maximum(d, 0) if joint.type == "prismatic" else np.abs(d) for d in depths]
    out = np.array([d.mean() for d in off]) / size
    at_zero = at_end and candidates[0] == zero
    slack = 0.05 if at_zero else 0.005 if joint.type == "prismatic" else 0.03
    near = [k for k in range(len(candidates)) if out[k] <= out.min() + slack]
    if joint.type == "prismatic" or near == [0] or (at_zero and near[0] == 0):
        return candidates[near[0]]

    rng = np.random.default_rng(0)
    low, high = rest.reshape(-1, 3).min(axis=0), rest.reshape(-1, 3).max(axis=0)
    inside = rng.uniform(low, high, (4000, 3))
    inside = inside[_depth(equations, inside) < -0.05 * size][:1000]
    starts, ways = np.repeat(inside, 4, axis=0), rng.normal(size=(4 * len(inside), 3))
    free = ~meets_any(rest, starts, ways)
    covered = [meets_any(p, starts[free], ways[free]).sum() / max(len(starts), 1) for p in posed]
    if at_zero:
        return candidates[1] if covered[1] >= covered[0] else candidates[0]
    return candidates[max(near, key=lambda k: (round(covered[k], 2), -round(100 * out[k]), -k))]


def _depth(equations: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Signed distance [n] of points [n, 3] to the planes of a hull: above 0 outside (a lower bound there)."""
    return (points @ equations[:, :3].T + equations[:, 3]).max(axis=1)
