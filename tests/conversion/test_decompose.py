"""Hulls cover what is seen, leave free what is free, and keep to their budget."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from generated import box
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull, Delaunay

from conversion.config import DecomposeConfig
from conversion.decompose import decompose, merge_hulls
from conversion.fidelity import measure_fidelity
from conversion.model import ConvexShape, Visual
from conversion.part_detection import detect_parts
from conversion.readers import read_object
from conversion.readers.mesh_reader import clean
from conversion.surface import Surface

CONFIG = DecomposeConfig()


def hulls_of(
    visuals: list[Visual], budget: int = 16, config: DecomposeConfig = CONFIG, seed: int = 0
) -> list[ConvexShape]:
    return decompose(Surface(visuals, seed), budget, config)


def leaf(name: str, vertices: np.ndarray, faces: np.ndarray) -> Visual:
    return Visual(name=name, vertices=vertices, faces=faces, is_handle="handle" in name, file=None)


def covered(hulls: list[ConvexShape], points: np.ndarray, slack: float = 1e-6) -> np.ndarray:
    equations = [ConvexHull(h.vertices).equations for h in hulls]
    out = np.stack([(points @ e[:, :3].T + e[:, 3]).max(axis=1) for e in equations])
    return out.min(axis=0) <= slack


def tray(wall: float) -> list[Visual]:
    """An open box of five boards, as one visual; without walls' thickness it is five sheets."""
    walls = [
        ((0, 0, 0), (1, 1, wall)),
        ((0, 0, 0), (wall, 1, 0.4)),
        ((1 - wall, 0, 0), (1, 1, 0.4)),
        ((0, 0, 0), (1, wall, 0.4)),
        ((0, 1 - wall, 0), (1, 1, 0.4)),
    ]
    boxes = [box("w", low, high) for low, high in walls]
    start = np.cumsum([0] + [len(b.vertices) for b in boxes])
    vertices = np.concatenate([b.vertices for b in boxes])
    faces = np.concatenate([b.faces + s for b, s in zip(boxes, start, strict=False)])
    return [leaf("tray-1", *clean(vertices, faces))]


def handle(name: str = "handle-1", room: float = 0.04) -> Visual:
    """A bar on two posts, `room` in front of a board whose front is at x = 0."""
    boxes = [
        box(name, (-room - 0.02, 0.3, 0.45), (-room, 0.7, 0.47)),
        box(name, (-room, 0.3, 0.45), (0, 0.32, 0.47)),
        box(name, (-room, 0.68, 0.45), (0, 0.7, 0.47)),
    ]
    start = np.cumsum([0] + [len(b.vertices) for b in boxes])
    vertices = np.concatenate([b.vertices for b in boxes])
    return leaf(name, vertices, np.concatenate([b.faces + s for b, s in zip(boxes, start, strict=False)]))


def test_a_board_is_one_exact_hull():
    (hull,) = hulls_of([box("board-1", (0, 0, 0), (1, 0.6, 0.02))])
    assert len(hull.vertices) == 8
    assert np.sort(np.unique(hull.vertices[:, 1])) == pytest.approx([0, 0.6])


@pytest.mark.parametrize("wall", [0.03, 0.0])
def test_an_open_box_keeps_its_inside_free(wall):
    visuals = tray(wall)
    hulls = hulls_of(visuals)
    assert 5 <= len(hulls) <= 6
    rng = np.random.default_rng(0)
    inside = rng.uniform((0.05, 0.05, 0.05), (0.95, 0.95, 0.4), (2000, 3))
    assert not covered(hulls, inside).any()
    assert covered(hulls, visuals[0].vertices, 1e-3).all()


def test_flat_sheets_become_thick_enough_to_collide():
    sheet = leaf("s", np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), np.array([[0, 1, 2]]))
    (hull,) = hulls_of([sheet])
    assert np.ptp(hull.vertices[:, 2]) == pytest.approx(CONFIG.thickness)


@pytest.mark.parametrize("room", [0.04, 0.015])
def test_the_gap_behind_a_handle_stays_free_and_handles_stay_apart(room):
    """Also a gap that is narrower than two voxels of its door, and of which half is near the door's surface."""
    hulls = hulls_of([box("door-2", (0, 0, 0), (0.03, 1, 1)), handle(room=room)])
    assert sum(h.is_handle for h in hulls) == 3
    gap = np.random.default_rng(0).uniform((-room + 1e-3, 0.33, 0.45), (-1e-3, 0.67, 0.47), (500, 3))
    assert not covered(hulls, gap).any()


def test_a_recess_behind_a_handle_is_finer_than_elsewhere():
    """A pocket 0.012 deep is within the tolerance of a board, but not where fingers go."""
    ring = [
        box("p", (0, 0, 0), (0.02, 0.25, 1)),
        box("p", (0, 0.75, 0), (0.02, 1, 1)),
        box("p", (0, 0, 0), (0.02, 1, 0.3)),
        box("p", (0, 0, 0.6), (0.02, 1, 1)),
        box("p", (0.012, 0, 0), (0.02, 1, 1)),
    ]
    start = np.cumsum([0] + [len(b.vertices) for b in ring])
    vertices = np.concatenate([b.vertices for b in ring])
    faces = np.concatenate([b.faces + s for b, s in zip(ring, start, strict=False)])
    panel = leaf("panel-3", vertices, faces)
    pocket = np.array([[0.006, 0.5, 0.46]])
    assert covered(hulls_of([panel]), pocket).all()
    assert not covered([h for h in hulls_of([panel, handle()]) if not h.is_handle], pocket).any()


def test_what_nothing_reaches_is_dropped_or_filled():
    shell, core = tray(0.03)[0], box("core", (0.4, 0.4, 0.15), (0.6, 0.6, 0.25))
    lid = box("lid", (0, 0, 0.4), (1, 1, 0.43))
    assert len(hulls_of([shell, lid, core])) == 1
    assert covered(hulls_of([shell, core]), np.array([[0.5, 0.5, 0.2]])).all()


def test_budget_and_vertex_limit_hold_whatever_comes():
    rng = np.random.default_rng(3)
    scatter = [box(f"b-{i}", *(lambda a: (a, a + rng.uniform(0.02, 0.2, 3)))(rng.uniform(0, 2, 3))) for i in range(60)]
    ball = trimesh.creation.icosphere(3, 0.2)
    scatter.append(leaf("ball", np.asarray(ball.vertices) + 3, np.asarray(ball.faces)))
    scatter += [replace(handle(f"handle-{i}"), vertices=handle().vertices + np.array([0, 0, i])) for i in range(8)]
    hulls = hulls_of(scatter, budget=16)
    assert len(hulls) <= 16
    assert max(len(h.vertices) for h in hulls) <= CONFIG.max_vertices
    assert 0 < sum(h.is_handle for h in hulls) <= 8


def test_same_input_gives_the_same_hulls():
    visuals = [box("door-2", (0, 0, 0), (0.03, 1, 1)), handle(), *tray(0.03)]
    first, _, again = hulls_of(visuals), hulls_of(tray(0.0)), hulls_of(visuals)
    assert [h.vertices.tolist() for h in first] == [h.vertices.tolist() for h in again]


def test_coacd_takes_concave_leaves_apart_too():
    profile = trimesh.path.polygons.Polygon([(0, 0), (1, 0), (1, 0.2), (0.2, 0.2), (0.2, 1), (0, 1)])
    corner = trimesh.creation.extrude_polygon(profile, 0.3)
    visuals = [leaf("corner-1", np.asarray(corner.vertices), np.asarray(corner.faces))]
    hulls = hulls_of(visuals, config=replace(CONFIG, decomposer="coacd"))
    assert 2 <= len(hulls) <= 16
    assert measure_fidelity(Surface(visuals), hulls).gap_max < 0.02


def test_hulls_of_several_groups_merge_to_a_budget_and_keep_what_they_can():
    drawers = [box(f"front-{i}", (0, 0, 0.2 * i), (0.02, 1, 0.2 * i + 0.19)) for i in range(5)]
    post = box("post", (0, 3, 0), (0.1, 3.1, 1))
    hulls = [ConvexShape(vertices=v.vertices, is_handle=False) for v in (*drawers, post)]
    kept, new = merge_hulls(Surface([*drawers, post]), hulls, 2, CONFIG)
    assert kept == [5]
    assert len(new) == 1
    assert np.ptp(new[0].vertices, axis=0) == pytest.approx([0.02, 1, 0.99])


def test_fidelity_measures_gap_and_phantom():
    board = box("b", (0, 0, 0), (1, 1, 0.1))
    surface = Surface([board])
    exact = measure_fidelity(surface, [ConvexShape(vertices=board.vertices, is_handle=False)])
    assert exact.gap_max == pytest.approx(0, abs=1e-9)
    assert exact.phantom_p95 < 0.004 and exact.phantom_share == 0
    moved = measure_fidelity(surface, [ConvexShape(vertices=board.vertices + np.array([0, 0, 0.03]), is_handle=False)])
    assert moved.gap_max == pytest.approx(0.03, abs=1e-3)
    assert moved.phantom_max == pytest.approx(0.03, abs=4e-3)
    assert 0.3 < moved.phantom_share < 0.8


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000))
def test_distances_to_the_surface_are_right_to_the_sample_spacing(seed):
    rng = np.random.default_rng(seed)
    mesh = trimesh.Trimesh(rng.uniform(0, 1, (9, 3)), np.arange(9).reshape(3, 3), process=False)
    surface = Surface([leaf("t", np.asarray(mesh.vertices), np.asarray(mesh.faces))])
    points = rng.uniform(0, 1, (200, 3))
    _, expected, _ = trimesh.proximity.closest_point_naive(mesh, points)
    found = surface.distance(points)[expected < 0.05]
    assert (found > expected[expected < 0.05] - 1e-9).all()
    assert found == pytest.approx(expected[expected < 0.05], abs=8e-3)


def test_real_parts_are_covered_and_free_of_phantoms(real_objects):
    for name in ("45194", "101619"):
        obj = read_object(real_objects / name)
        moving = [p.link for p in detect_parts(obj)[0]]
        for group in (obj.root, *moving):
            surface = Surface(obj.group_visuals(group))
            hulls = decompose(surface, 32 if group == obj.root else 16, CONFIG)
            match = measure_fidelity(surface, hulls)
            assert match.gap_max < 0.005, (name, group)
            assert match.phantom_share < (0.05 if group == obj.root else 0.02), (name, group)
            assert max(len(h.vertices) for h in hulls) <= 32
            assert all(Delaunay(h.vertices).simplices.size for h in hulls)
