"""Rotations and gripper frames, on device.

Quaternions are wxyz. Euler angles are intrinsic XYZ (R = Rx Ry Rz), the order of the gripper's three hinges. A
gripper frame's columns are (forward, left, up): fingers open along left, the gripper approaches along up.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp


def normalize(x: jax.Array, axis: int = -1) -> jax.Array:
    """x scaled to unit length; zero stays zero, and so does its gradient."""
    square = jnp.sum(x * x, axis, keepdims=True)
    return x * jax.lax.rsqrt(jnp.maximum(square, 1e-12))


def matrix_from_quat(q: jax.Array) -> jax.Array:
    """[..., 4] unit wxyz -> [..., 3, 3]."""
    w, x, y, z = jnp.moveaxis(q, -1, 0)
    return _rows(
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def quat_from_matrix(m: jax.Array) -> jax.Array:
    """[..., 3, 3] -> [..., 4] unit wxyz, w >= 0. Shepperd's method, the largest of four divisors."""
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    sx, sy, sz = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    candidates = _rows(
        (1 + xx + yy + zz, sx, sy, sz),
        (sx, 1 + xx - yy - zz, xy, xz),
        (sy, xy, 1 - xx + yy - zz, yz),
        (sz, xz, yz, 1 - xx - yy + zz),
    )
    largest = jnp.argmax(jnp.diagonal(candidates, axis1=-2, axis2=-1), -1)
    q = normalize(jnp.take_along_axis(candidates, largest[..., None, None], -2)[..., 0, :])
    return jnp.where(q[..., :1] < 0, -q, q)


def matrix_from_rotvec(v: jax.Array) -> jax.Array:
    """[..., 3] axis times angle (rad) -> [..., 3, 3]. Rodrigues' formula, smooth at zero."""
    square = jnp.sum(v * v, -1)
    small = square < 1e-8
    angle = jnp.sqrt(jnp.where(small, 1.0, square))
    a = jnp.where(small, 1 - square / 6, jnp.sin(angle) / angle)[..., None, None]
    b = jnp.where(small, 0.5 - square / 24, (1 - jnp.cos(angle)) / (angle * angle))[..., None, None]
    k = cross_matrix(v)
    return jnp.eye(3) + a * k + b * (k @ k)


def rotvec_from_matrix(m: jax.Array) -> jax.Array:
    """[..., 3, 3] -> [..., 3] axis times angle in [0, pi]."""
    q = quat_from_matrix(m)
    sine = jnp.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2 * jnp.arctan2(sine, q[..., :1])
    return q[..., 1:] * jnp.where(sine < 1e-6, 2.0, angle / jnp.maximum(sine, 1e-6))


def matrix_from_euler(e: jax.Array) -> jax.Array:
    """[..., 3] intrinsic XYZ angles (rad) -> [..., 3, 3]."""
    (cx, cy, cz), (sx, sy, sz) = jnp.moveaxis(jnp.cos(e), -1, 0), jnp.moveaxis(jnp.sin(e), -1, 0)
    return _rows(
        (cy * cz, -cy * sz, sy),
        (cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy),
        (sx * sz - cx * sy * cz, sx * cz + cx * sy * sz, cx * cy),
    )


def euler_from_matrix(m: jax.Array) -> jax.Array:
    """[..., 3, 3] -> [..., 3] intrinsic XYZ angles (rad), the middle one in [-pi/2, pi/2]."""
    return jnp.stack(
        [
            jnp.arctan2(-m[..., 1, 2], m[..., 2, 2]),
            jnp.arcsin(jnp.clip(m[..., 0, 2], -1, 1)),
            jnp.arctan2(-m[..., 0, 1], m[..., 0, 0]),
        ],
        -1,
    )


def matrix_from_rot6d(r: jax.Array) -> jax.Array:
    """[..., 6] (up, forward) -> [..., 3, 3] gripper frame, by Gram-Schmidt with up first (Zhou et al. 2019)."""
    up = normalize(r[..., :3])
    forward = normalize(r[..., 3:] - jnp.sum(r[..., 3:] * up, -1, keepdims=True) * up)
    return jnp.stack([forward, jnp.cross(up, forward), up], -1)


def rot6d_from_matrix(m: jax.Array) -> jax.Array:
    """[..., 3, 3] gripper frame -> [..., 6] (up, forward)."""
    return jnp.concatenate([m[..., :, 2], m[..., :, 0]], -1)


def cross_matrix(v: jax.Array) -> jax.Array:
    """[..., 3] -> [..., 3, 3] with cross_matrix(v) @ u = v x u."""
    x, y, z = jnp.moveaxis(v, -1, 0)
    o = jnp.zeros_like(x)
    return _rows((o, -z, y), (z, o, -x), (-y, x, o))


def rotate(m: jax.Array, v: jax.Array) -> jax.Array:
    """m v for matrices [..., 3, 3] and vectors [..., 3]."""
    return jnp.einsum("...ij,...j->...i", m, v)


def unrotate(m: jax.Array, v: jax.Array) -> jax.Array:
    """m^T v for matrices [..., 3, 3] and vectors [..., 3]."""
    return jnp.einsum("...ji,...j->...i", m, v)


def cone_direction(key: jax.Array, axis: jax.Array, half_angle: float) -> jax.Array:
    """Unit vectors uniform in the cone of `half_angle` (rad) about unit `axis` [..., 3]. Consumes the key."""
    k1, k2 = jax.random.split(key)
    cosine = jax.random.uniform(k1, (*axis.shape[:-1], 1), minval=jnp.cos(half_angle), maxval=1.0)
    v = jax.random.normal(k2, axis.shape)
    tangent = normalize(v - jnp.sum(v * axis, -1, keepdims=True) * axis)
    return cosine * axis + jnp.sqrt(1 - cosine**2) * tangent


def gripper_frame(up: jax.Array, forward: jax.Array) -> jax.Array:
    """Gripper frames [..., 3, 3] that approach along unit `up`, with `forward` made orthogonal to it."""
    return matrix_from_rot6d(jnp.concatenate([up, forward], -1))


def carried(point: jax.Array, axis: jax.Array, anchor: jax.Array, amount: jax.Array, hinge: bool) -> jax.Array:
    """[..., 3] where points [..., 3] of a part come to when its joint moves by `amount` [...], rad or unit lengths.

    axis: [..., 3] unit; anchor: [..., 3] a point on a hinge's axis.
    """
    if hinge:
        return anchor + rotate(matrix_from_rotvec(axis * amount[..., None]), point - anchor)
    return point + axis * amount[..., None]


def _rows(*rows: tuple[jax.Array, ...]) -> jax.Array:
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)
