"""Lids are told from doors by what the object says, and closed where they lie on the box."""

from __future__ import annotations

import numpy as np
import pytest
from generated import box, made

from conversion.model import ConvertedObject, Joint, Part, Visual
from conversion.part_detection import detect_parts
from conversion.readers import read_object
from conversion.scenes import scene_bank, scene_specs
from vatmart_jax.data.part_kinds import HINGE

BOARDS = [
    box("bottom", (-0.4, -0.5, -0.3), (0.4, 0.5, -0.28)),
    box("front", (-0.4, -0.5, -0.3), (-0.38, 0.5, 0.3)),
    box("back", (0.38, -0.5, -0.3), (0.4, 0.5, 0.3)),
    box("left", (-0.4, -0.5, -0.3), (0.4, -0.48, 0.3)),
    box("right", (-0.4, 0.48, -0.3), (0.4, 0.5, 0.3)),
]
LID = box("lid-1", (-0.8, -0.5, 0.0), (0.0, 0.5, 0.02))  # closed, in a frame on its hinge at the upper edge of the back


def hinge(lower: float, upper: float, axis: tuple = (0, 1, 0), child: str = "lid", modelled: float = 0.0) -> Joint:
    """At joint value 0 the lid stands `modelled` rad above closed."""
    c, s = np.cos(modelled), np.sin(modelled)
    origin = np.eye(4)
    origin[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    origin[:3, 3] = (0.4, 0, 0.3)
    return Joint(
        name=f"joint_{child}", type="revolute", parent="base", child=child, origin=origin, axis=np.array(axis, float),
        lower=lower, upper=upper,
    )  # fmt: skip


def chest(joint: Joint, lid: Visual = LID, category: str = "Box") -> ConvertedObject:
    return made("chest", {"base": BOARDS, "lid": [lid]}, [joint], category, {"lid": "rotation_lid"})


def edge_height(converted: ConvertedObject, part: Part, q: float) -> float:
    """Of the free edge of the lid above the hinge."""
    pose = converted.obj.link_poses({part.joint: part.closed + part.sign * q})[part.link]
    visual = converted.obj.links[part.link].visuals[0]
    corners = visual.vertices[visual.vertices[:, 0] < -0.7] @ pose[:3, :3].T + pose[:3, 3]
    return float(corners[:, 2].mean() - 0.3)


@pytest.mark.parametrize("axis", [(0, 1, 0), (0, -1, 0)])
@pytest.mark.parametrize(
    ("lower", "upper", "modelled", "closed"),
    [
        (0.0, 1.5, 0.0, 0.0),  # begins at closed
        (-0.7, 1.2, 0.7, -0.7),  # modelled ajar
        (-1.57, 0.0, 1.57, -1.57),  # modelled open
        (-1.4, 1.5, 0.0, 0.0),  # may also hang into the box
        (-2.0, 1.0, 1.0, -1.0),  # the same, and modelled ajar
        (-0.05, 1.5, 0.0, 0.0),
    ],
)
def test_a_lid_is_closed_where_it_lies_on_the_box_and_opens_upwards(axis, lower, upper, modelled, closed):
    if axis[1] < 0:
        lower, upper, closed = -upper, -lower, -closed
    converted = chest(hinge(lower, upper, axis, modelled=modelled))
    (part,) = converted.parts
    assert (part.kind, part.sign) == ("lid", int(axis[1]))
    assert part.closed == pytest.approx(closed, abs=0.03)
    assert part.closed + part.sign * part.joint_range == pytest.approx(upper if axis[1] > 0 else lower)
    assert abs(edge_height(converted, part, 0.0)) < 0.05
    assert edge_height(converted, part, 0.5) > edge_height(converted, part, 0.1) > edge_height(converted, part, 0.0)
    bank = scene_bank(scene_specs(converted, 1, 0), "hull")
    assert bank.part_kind.tolist() == ["lid"] and bank.joint_type.tolist() == [HINGE]


def test_what_is_called_a_lid_and_is_none_is_left_out_with_a_reason():
    upright = hinge(0, 1.5, (0, 0, 1))
    assert chest(upright).left_out == [("joint_lid", "is a lid whose hinge is not horizontal")]
    assert chest(hinge(0.6, 1.5)).left_out == [("joint_lid", "is a lid that lies level nowhere in its range")]
    outside = box("lid-1", (0.2, -0.5, 0.0), (0.8, 0.5, 0.02))
    assert chest(hinge(-0.2, 0.2), outside).left_out == [("joint_lid", "is a lid that does not lie on the body")]


def test_a_lid_that_hangs_on_another_is_left_out():
    fold = Joint(
        name="joint_fold", type="revolute", parent="lid", child="fold", origin=np.eye(4), axis=np.array([0, 1.0, 0]),
        lower=0, upper=1.5,
    )  # fmt: skip
    links = {"base": BOARDS, "lid": [LID], "fold": [LID]}
    lids = {"lid": "rotation_lid", "fold": "rotation_lid"}
    converted = made("carton", links, [hinge(0, 1.5), fold], "Box", lids)
    assert [p.link for p in converted.parts] == ["lid"]
    assert converted.left_out == [("joint_fold", "hangs on a part that moves itself")]


def test_a_lid_of_another_category_is_a_door_as_before():
    assert [p.kind for p in chest(hinge(0, 1.5), category="WashingMachine").parts] == ["door"]


# Degrees, read from pictures of all of them closed and open; two have no joint, and nested flaps are no lids.
REAL = {
    "100129": [-130, -120], "100141": [-90], "100154": [-225] * 4, "100174": [-23], "100189": [-40], "100191": [],
    "100194": [-209, -230, -210, -230], "100214": [-96], "100221": [-60], "100234": [-129, -116], "100243": [-40],
    "100247": [-33], "100426": [-187, -186], "100658": [-134, -132, -135, -131], "100664": [-108], "100671": [-22],
    "100676": [-128, -196, -148, -92], "100685": [], "102379": [-90], "102456": [-45], "47645": [0], "48492": [0],
}  # fmt: skip


def test_real_lids_are_closed_and_open_the_way_they_look(real_objects):
    for name, closed in REAL.items():
        found, _ = detect_parts(read_object(real_objects / name))
        assert [(p.kind, p.sign) for p in found] == [("lid", 1)] * len(closed), name
        assert np.degrees([p.closed for p in found]) == pytest.approx(closed, abs=1), name
