import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from vatmart_jax import rotations as rot
from vatmart_jax.trajectory import WAYPOINTS, min_jerk, pack_trajectory, unpack_trajectory

PROPERTY = settings(deadline=None, max_examples=60)
unit = arrays(np.float64, 3, elements=st.floats(-1, 1)).filter(lambda v: np.linalg.norm(v) > 0.1)
angle = st.one_of(st.floats(0, np.pi), st.floats(np.pi - 1e-3, np.pi), st.floats(0, 1e-3))
angles = arrays(np.float64, 3, elements=st.floats(-np.pi, np.pi))

matrix_from_quat, quat_from_matrix = jax.jit(rot.matrix_from_quat), jax.jit(rot.quat_from_matrix)
matrix_from_rotvec, rotvec_from_matrix = jax.jit(rot.matrix_from_rotvec), jax.jit(rot.rotvec_from_matrix)
matrix_from_euler, euler_from_matrix = jax.jit(rot.matrix_from_euler), jax.jit(rot.euler_from_matrix)
matrix_from_rot6d = jax.jit(rot.matrix_from_rot6d)
sample_cone_direction = jax.jit(rot.sample_cone_direction)
pack_trajectory, unpack_trajectory = jax.jit(pack_trajectory), jax.jit(unpack_trajectory)


def rotvec(axis, angle) -> np.ndarray:
    return axis / np.linalg.norm(axis) * angle


def assert_same(actual, expected, atol=2e-6):
    np.testing.assert_allclose(actual, expected, atol=atol, rtol=0)


@PROPERTY
@given(unit, angle)
@example(np.array([1.0, 0, 0]), np.pi)
@example(np.array([0, 1.0, 0]), np.pi)
@example(np.array([0, 0, 1.0]), np.pi)
@example(np.array([1.0, 1, 0]), np.pi)
def test_rotation_vectors_are_scipys(axis, angle):
    vector = rotvec(axis, angle)
    matrix = Rotation.from_rotvec(vector).as_matrix()
    assert_same(matrix_from_rotvec(jnp.asarray(vector, jnp.float32)), matrix)
    # At half a turn both signs of the axis are right, so rotations are compared.
    back = np.asarray(rotvec_from_matrix(jnp.asarray(matrix, jnp.float32)), np.float64)
    assert np.linalg.norm(back) <= np.pi + 1e-6
    assert_same(Rotation.from_rotvec(back).as_matrix(), matrix, 5e-6)


@PROPERTY
@given(unit, angle)
@example(np.array([0, 0, 1.0]), np.pi)
def test_quaternions_are_scipys_with_w_at_least_zero(axis, angle):
    rotation = Rotation.from_rotvec(rotvec(axis, angle))
    assert_same(matrix_from_quat(jnp.asarray(rotation.as_quat(scalar_first=True), jnp.float32)), rotation.as_matrix())
    quat = np.asarray(quat_from_matrix(jnp.asarray(rotation.as_matrix(), jnp.float32)), np.float64)
    assert quat[0] >= 0
    assert_same(np.linalg.norm(quat), 1)
    assert_same(Rotation.from_quat(quat, scalar_first=True).as_matrix(), rotation.as_matrix(), 5e-6)


@PROPERTY
@given(angles)
def test_euler_angles_are_scipys_intrinsic_xyz(euler):
    assert_same(matrix_from_euler(jnp.asarray(euler, jnp.float32)), Rotation.from_euler("XYZ", euler).as_matrix())


@PROPERTY
@given(angles)
def test_euler_angles_come_back_away_from_the_poles(euler):
    euler = euler * [1, 80 / 180, 1]
    matrix = jnp.asarray(Rotation.from_euler("XYZ", euler).as_matrix(), jnp.float32)
    back = np.asarray(euler_from_matrix(matrix))
    assert_same(np.cos(back - euler), 1, 1e-6)
    assert abs(back[1]) <= np.pi / 2


@PROPERTY
@given(unit, unit)
def test_rot6d_of_any_two_directions_is_a_right_handed_frame_with_up_kept(up, forward):
    if np.linalg.norm(np.cross(up, forward)) < 0.01:
        return
    frame = np.asarray(matrix_from_rot6d(jnp.asarray(np.concatenate([up, forward]), jnp.float32)))
    assert_same(frame.T @ frame, np.eye(3), 1e-5)
    assert_same(np.linalg.det(frame), 1, 1e-5)
    assert_same(frame[:, 2], up / np.linalg.norm(up), 1e-5)
    assert_same(matrix_from_rot6d(rot.rot6d_from_matrix(jnp.asarray(frame))), frame, 1e-5)


def test_gradients_at_zero_are_finite_and_right():
    jacobian = jax.jit(jax.jacobian(rot.matrix_from_rotvec))(jnp.zeros(3))
    assert_same(jacobian, np.moveaxis(rot.cross_matrix(jnp.eye(3)), 0, -1))
    assert np.isfinite(jax.jit(jax.jacobian(rot.normalize))(jnp.zeros(3))).all()
    assert np.isfinite(jax.jit(jax.jacobian(rot.matrix_from_rot6d))(jnp.zeros(6))).all()


def test_rotate_and_unrotate_are_products_with_a_matrix_and_its_transpose():
    m, v = Rotation.random(5, random_state=0).as_matrix(), np.random.default_rng(0).normal(size=(5, 3))
    assert_same(rot.rotate(jnp.asarray(m), jnp.asarray(v)), (m @ v[..., None])[..., 0])
    assert_same(rot.unrotate(jnp.asarray(m), rot.rotate(jnp.asarray(m), jnp.asarray(v))), v)
    assert_same(rot.cross_matrix(jnp.asarray(v)) @ jnp.asarray(v)[..., None], 0)


@pytest.mark.parametrize("half_angle_deg", [10, 30, 90])
def test_cone_directions_are_uniform_on_the_cap(half_angle_deg):
    half_angle = np.radians(half_angle_deg)
    axis = np.array([1.0, 2, -2]) / 3
    directions = np.asarray(
        sample_cone_direction(jax.random.key(0), jnp.tile(jnp.asarray(axis), (20_000, 1)), half_angle)
    )
    assert_same(np.linalg.norm(directions, axis=-1), 1, 1e-5)
    cosine = directions @ axis
    assert cosine.min() >= np.cos(half_angle) - 1e-5
    # Archimedes: areas on a sphere are heights. Five standard errors.
    width = 1 - np.cos(half_angle)
    assert_same(cosine.mean(), 1 - width / 2, 5 * width / np.sqrt(12 * len(cosine)))
    tangential = directions - cosine[:, None] * axis
    assert_same(tangential.mean(0), 0, 5 * np.sin(half_angle) / np.sqrt(len(cosine)))


def test_min_jerk_starts_and_stops_at_rest():
    u = jnp.linspace(-0.5, 1.5, 41)
    s = min_jerk(u)
    assert_same(s[u <= 0], 0)
    assert_same(s[u >= 1], 1)
    assert (np.diff(s) >= 0).all()
    ends = jnp.array([1e-4, 1 - 1e-4])
    assert_same(jax.jit(jax.vmap(jax.grad(min_jerk)))(ends), 0, 1e-3)
    assert_same(jax.jit(jax.vmap(jax.grad(jax.grad(min_jerk))))(ends), 0, 1e-2)


def test_trajectories_are_30_numbers_that_unpack_to_what_was_packed():
    rng = np.random.default_rng(0)
    frames = jnp.asarray(Rotation.random(6, random_state=0).as_matrix().reshape(2, 3, 3, 3), jnp.float32)
    residuals = jnp.asarray(rng.normal(size=(2, 3, WAYPOINTS, 6)), jnp.float32)
    packed = pack_trajectory(frames, residuals)
    assert packed.shape == (2, 3, 30)
    back_frames, back_residuals = unpack_trajectory(packed)
    assert_same(back_frames, frames)
    assert (back_residuals == residuals).all()
    # Up, the approach, first; then forward.
    assert_same(packed[..., :3], frames[..., 2])
    assert_same(packed[..., 3:6], frames[..., 0])


def test_unpacking_orthonormalises_predicted_rotations():
    trajectory = jnp.asarray(np.random.default_rng(0).normal(size=(100, 30)), jnp.float32)
    frames, _ = unpack_trajectory(trajectory)
    assert_same(frames.swapaxes(-1, -2) @ frames, np.broadcast_to(np.eye(3), (100, 3, 3)), 1e-5)
