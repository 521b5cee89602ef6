"""Rigid motions: exp, log, adjoint, inverse and interpolation of (..., 4, 4) transforms, vectorised.

Tangent order [rx ry rz tx ty tz] (rad, mm), right perturbation, both GTSAM's. The series near the identity are
those of Barfoot, State Estimation for Robotics (2017), 7.1, switched where they are exact to double precision.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])  # the axes after each and before each
_SMALL = 1e-4  # rad: below, the fourth-order series is exact to 1e-16 relative
_TINY = 1e-100  # rad: no different from no turn in any digit, even squared
_FEW = 8  # rows up to which plain floats take less time than arrays, a third for four


def hat(v: ArrayLike) -> Array:
    """Skew matrices (..., 3, 3) of vectors (..., 3): hat(v) @ w = cross(v, w)."""
    v = np.asarray(v, float)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def cross(a: Array, b: Array) -> Array:
    """numpy's `cross` of vectors (..., 3) in a third of its time, which several times a frame is worth having."""
    if a.ndim == b.ndim == 1:
        (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
        return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])
    return np.asarray(a[..., _NEXT] * b[..., _LAST] - a[..., _LAST] * b[..., _NEXT])


def _coefficients(angle: Array) -> tuple[Array, Array]:
    """sin(a)/a and (1 - cos a)/a^2, by formulas that keep their precision near zero."""
    a = np.maximum(angle, _TINY)
    return np.sin(a) / a, 2 * (np.sin(a / 2) / a) ** 2


def _third(a2: Array) -> Array:
    """(a - sin a)/a^3, with its series near zero, of a^2."""
    series = 1 / 6 - a2 * (1 / 120 - a2 * (1 / 5040 - a2 / 362880))
    if a2.max(initial=0.0) < 0.05**2:
        return np.asarray(series)
    a = np.sqrt(a2)
    return np.where(a < 0.05, series, (a - np.sin(a)) / np.maximum(a2 * a, _TINY))


def exp_rotation(w: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3), rad (Rodrigues)."""
    w = np.asarray(w, float)
    out = np.empty((*w.shape, 3))
    _turn(w[..., 0], w[..., 1], w[..., 2], out)
    return out


def _turn(x: Array, y: Array, z: Array, out: Array) -> tuple[Array, Array]:
    """cos(a) I + s hat(w) + c w w^T into out (..., 3, 3), of w = x y z (...) and its angle a; c and a^2, each (...)."""
    # by components: numpy takes a hundred numbers at once in the time of three
    a2 = x * x + y * y + z * z
    s, c = _coefficients(np.sqrt(a2))
    sx, sy, sz, cx, cy, cos = s * x, s * y, s * z, c * x, c * y, 1 - c * a2
    xy, xz, yz = cx * y, cx * z, cy * z
    out[..., 0, 0], out[..., 0, 1], out[..., 0, 2] = cos + cx * x, xy - sz, xz + sy
    out[..., 1, 0], out[..., 1, 1], out[..., 1, 2] = xy + sz, cos + cy * y, yz - sx
    out[..., 2, 0], out[..., 2, 1], out[..., 2, 2] = xz - sy, yz + sx, cos + c * z * z
    return c, a2


def log_rotation(rotation: ArrayLike) -> Array:
    """Rotation vectors (..., 3), rad, of length at most pi, of rotation matrices (..., 3, 3)."""
    q = quaternion_from_rotation(rotation)
    q = np.where(q[..., 3:] < 0, -q, q)
    n = np.linalg.norm(q[..., :3], axis=-1)
    angle = 2 * np.arctan2(n, q[..., 3])
    scale = np.where(n < 1e-8, 2.0, angle / np.where(n < 1e-8, 1.0, n))
    return np.asarray(scale[..., None] * q[..., :3])


def exp(xi: ArrayLike) -> Array:
    """Transforms (..., 4, 4) of tangent vectors (..., 6): the exponential map of SE(3)."""
    xi = np.asarray(xi, float)
    if xi.ndim == 1:
        return _exp_one(xi)
    if 0 < xi.size <= 6 * _FEW and np.isfinite(xi).all():
        return np.array([_exp_one(row) for row in xi.reshape(-1, 6)]).reshape(*xi.shape[:-1], 4, 4)
    x, y, z, tx, ty, tz = (xi[..., k] for k in range(6))
    out = np.zeros((*xi.shape[:-1], 4, 4))
    c, a2 = _turn(x, y, z, out[..., :3, :3])
    d = _third(a2)
    e, f = 1 - d * a2, d * (x * tx + y * ty + z * tz)  # of the left Jacobian: e I + c hat(w) + d w w^T
    out[..., 0, 3] = e * tx + c * (y * tz - z * ty) + f * x
    out[..., 1, 3] = e * ty + c * (z * tx - x * tz) + f * y
    out[..., 2, 3] = e * tz + c * (x * ty - y * tx) + f * z
    out[..., 3, 3] = 1.0
    return out


def _exp_one(xi: Array) -> Array:
    """`exp` of one tangent vector in plain floats: forty times a frame, at a sixth of the arrays' time."""
    entries = exp_entries(*xi.tolist())
    return np.array([*entries, 0.0, 0.0, 0.0, 1.0]).reshape(4, 4)


def exp_entries(x: float, y: float, z: float, tx: float, ty: float, tz: float) -> tuple[float, ...]:
    """The upper three rows of `exp` of one tangent vector, one after the other."""
    a2 = x * x + y * y + z * z
    a = math.sqrt(a2)
    if a < _SMALL:
        s, c = 1 - a2 / 6, 0.5 - a2 / 24
    else:
        s, c = math.sin(a) / a, 2 * (math.sin(a / 2) / a) ** 2
    d = 1 / 6 - a2 / 120 + a2**2 / 5040 - a2**3 / 362880 if a < 0.05 else (a - math.sin(a)) / (a2 * a)
    wt = x * tx + y * ty + z * tz
    e = 1 - d * a2  # of the left Jacobian: e I + c hat(w) + d w w^T
    cos = 1 - c * a2
    one = cos + c * x * x, c * x * y - s * z, c * x * z + s * y, e * tx + c * (y * tz - z * ty) + d * wt * x
    two = c * x * y + s * z, cos + c * y * y, c * y * z - s * x, e * ty + c * (z * tx - x * tz) + d * wt * y
    three = c * x * z - s * y, c * y * z + s * x, cos + c * z * z, e * tz + c * (x * ty - y * tx) + d * wt * z
    return one + two + three


def log(transform: ArrayLike) -> Array:
    """Tangent vectors (..., 6) of transforms (..., 4, 4): inverse of `exp` for rotations below pi."""
    transform = np.asarray(transform, float)
    if transform.ndim == 2:
        return _log_one(transform)
    if 0 < transform.size <= 16 * _FEW and np.isfinite(transform).all():
        return np.array([_log_one(each) for each in transform.reshape(-1, 4, 4)]).reshape(*transform.shape[:-2], 6)
    w = log_rotation(transform[..., :3, :3])
    angle = np.linalg.norm(w, axis=-1)
    s, c = _coefficients(angle)
    small = angle < 0.05
    series = 1 / 12 + angle**2 / 720 + angle**4 / 30240
    e = np.where(small, series, (1 - s / (2 * c)) / np.where(small, 1.0, angle) ** 2)
    h = hat(w)
    inverse_left = np.eye(3) - 0.5 * h + e[..., None, None] * (h @ h)
    return np.concatenate([w, (inverse_left @ transform[..., :3, 3:])[..., 0]], axis=-1)


def _log_one(transform: Array) -> Array:
    """`log` of one transform in plain floats, as `_exp_one`."""
    (xx, xy, xz, tx), (yx, yy, yz, ty), (zx, zy, zz, tz), _ = transform.tolist()
    # quaternion x y z w of the rotation, not of unit length
    if xx + yy + zz > 0:
        q = zy - yz, xz - zx, yx - xy, 1 + xx + yy + zz
    elif xx >= yy and xx >= zz:
        q = 1 + xx - yy - zz, xy + yx, xz + zx, zy - yz
    elif yy >= zz:
        q = xy + yx, 1 + yy - xx - zz, yz + zy, xz - zx
    else:
        q = xz + zx, yz + zy, 1 + zz - xx - yy, yx - xy
    length = math.copysign(math.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2), q[3])
    qx, qy, qz, qw = q[0] / length, q[1] / length, q[2] / length, q[3] / length
    # rotation vector, and the inverse of the left Jacobian
    n = math.sqrt(qx * qx + qy * qy + qz * qz)
    angle = 2 * math.atan2(n, qw)
    scale = 2.0 if n < 1e-8 else angle / n
    x, y, z = scale * qx, scale * qy, scale * qz
    a2 = x * x + y * y + z * z
    if angle < 0.05:
        k = 1 / 12 + a2 / 720 + a2 * a2 / 30240
    else:
        half = 0.5 * angle
        k = (1 - half * math.cos(half) / math.sin(half)) / a2
    ux, uy, uz = y * tz - z * ty, z * tx - x * tz, x * ty - y * tx  # hat(w) @ t
    vx, vy, vz = y * uz - z * uy, z * ux - x * uz, x * uy - y * ux
    return np.array([x, y, z, tx - 0.5 * ux + k * vx, ty - 0.5 * uy + k * vy, tz - 0.5 * uz + k * vz])


def make(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """Transforms (..., 4, 4) from rotations (..., 3, 3) and translations (..., 3), mm."""
    rotation, translation = np.asarray(rotation, float), np.asarray(translation, float)
    shape = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    out = np.zeros((*shape, 4, 4))
    out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = rotation, translation, 1.0
    return out


def inverse(transform: ArrayLike) -> Array:
    """b_from_a (..., 4, 4) of a_from_b."""
    transform = np.asarray(transform, float)
    r = np.swapaxes(transform[..., :3, :3], -1, -2)
    out = np.zeros(transform.shape)
    out[..., :3, :3], out[..., :3, 3:], out[..., 3, 3] = r, -(r @ transform[..., :3, 3:]), 1.0
    return out


def adjoint(transform: ArrayLike) -> Array:
    """Ad (..., 6, 6) with T @ exp(xi) @ inverse(T) = exp(Ad(T) @ xi)."""
    transform = np.asarray(transform, float)
    r = transform[..., :3, :3]
    out = np.zeros((*transform.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = r
    out[..., 3:, :3] = hat(transform[..., :3, 3]) @ r
    return out


def small_adjoint(xi: Array) -> Array:
    """ad (..., 6, 6) of tangent vectors (..., 6): ad(x) @ y is their Lie bracket."""
    out = np.zeros((*xi.shape, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = hat(xi[..., :3])
    out[..., 3:, :3] = hat(xi[..., 3:])
    return out


def right_jacobian(xi: Array) -> Array:
    """J (..., 6, 6) with exp(xi + d) = exp(xi) exp(J d), by its series (Barfoot 2017, 7.1.5): 1e-6 up to 0.3 rad."""
    ad = small_adjoint(xi)
    square = ad @ ad
    return np.asarray(np.eye(6) - ad / 2 + square / 6 - square @ ad / 24 + square @ square / 120)


def inverse_right_jacobian(xi: Array) -> Array:
    """Inverse (..., 6, 6) of `right_jacobian` by its Bernoulli series: exact to 1e-7 up to half a radian."""
    ad = small_adjoint(xi)
    square = ad @ ad
    return np.asarray(np.eye(6) + ad / 2 + square / 12 - square @ square / 720 + square @ square @ square / 30240)


def interpolate(a: ArrayLike, b: ArrayLike, u: ArrayLike) -> Array:
    """Geodesic from a (..., 4, 4) at u = 0 to b at u = 1; u (...) may lie outside [0, 1]."""
    a, b, u = np.asarray(a, float), np.asarray(b, float), np.asarray(u, float)
    return np.asarray(a @ exp(u[..., None] * log(inverse(a) @ b)))


def transform_points(a_from_b: ArrayLike, points_b: ArrayLike) -> Array:
    """Points in a (..., N, 3), mm, from points in b (..., N, 3)."""
    a_from_b = np.asarray(a_from_b, float)
    rotated = np.asarray(points_b, float) @ np.swapaxes(a_from_b[..., :3, :3], -1, -2)
    return np.asarray(rotated + a_from_b[..., None, :3, 3])


def point_jacobians(points: Array) -> Array:
    """How points (N, 3) move with a right perturbation of their frame's pose, per rad and mm: (N, 3, 6)."""
    return np.concatenate([-hat(points), np.broadcast_to(np.eye(3), (len(points), 3, 3))], -1)


def angle_of(rotation: ArrayLike) -> Array:
    """Rotation angle (...), rad in [0, pi], of rotations (..., 3, 3) or transforms (..., 4, 4)."""
    return np.asarray(np.linalg.norm(log_rotation(np.asarray(rotation, float)[..., :3, :3]), axis=-1))


def is_transform(matrix: ArrayLike, tolerance: float = 1e-5) -> bool:
    """Whether a (4, 4) matrix is a rigid motion: finite, orthonormal, right-handed, last row 0 0 0 1."""
    m = np.asarray(matrix, float)
    if m.shape != (4, 4) or not np.isfinite(m).all() or np.abs(m[3] - [0, 0, 0, 1]).max() > tolerance:
        return False
    r = m[:3, :3]
    if np.abs(r).max() > 1 + tolerance:  # its square may be too large to be told
        return False
    return bool(np.abs(r @ r.T - np.eye(3)).max() < tolerance and np.linalg.det(r) > 0)


def orthonormalise(transform: ArrayLike) -> Array:
    """The nearest rigid motion to a nearly rigid (4, 4) matrix (polar decomposition of its rotation)."""
    transform = np.asarray(transform, float)
    return make(nearest_rotation(transform[:3, :3]), transform[:3, 3])


def nearest_rotation(matrix: ArrayLike) -> Array:
    """Rotations (..., 3, 3) nearest to matrices (..., 3, 3), by squares of their differences (Kabsch 1976)."""
    u, _, vt = np.linalg.svd(np.asarray(matrix, float))
    u[..., 2] *= np.linalg.det(u @ vt)[..., None]
    return np.asarray(u @ vt)


def rigid_from_points(source: Array, target: Array) -> Array:
    """The motion (4, 4) that carries points (N, 3) onto others in least squares (Umeyama 1991, without scale)."""
    a, b = source.mean(0), target.mean(0)
    rotation = nearest_rotation((target - b).T @ (source - a))
    return make(rotation, b - rotation @ a)


def quaternion_from_rotation(rotation: ArrayLike) -> Array:
    """Unit quaternions (..., 4) [qx qy qz qw] of rotations (..., 3, 3) (Bar-Itzhack, largest of four candidates)."""
    r = np.asarray(rotation, float)
    xx, yy, zz = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    a, b, c = r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]
    d, e, f = r[..., 1, 0] + r[..., 0, 1], r[..., 0, 2] + r[..., 2, 0], r[..., 2, 1] + r[..., 1, 2]
    products = np.empty((*xx.shape, 4, 4))  # 4 q q^T
    products[..., 0, 0], products[..., 0, 1], products[..., 0, 2], products[..., 0, 3] = 1 + xx - yy - zz, d, e, a
    products[..., 1, 0], products[..., 1, 1], products[..., 1, 2], products[..., 1, 3] = d, 1 - xx + yy - zz, f, b
    products[..., 2, 0], products[..., 2, 1], products[..., 2, 2], products[..., 2, 3] = e, f, 1 - xx - yy + zz, c
    products[..., 3, 0], products[..., 3, 1], products[..., 3, 2], products[..., 3, 3] = a, b, c, 1 + xx + yy + zz
    best = np.argmax(np.diagonal(products, axis1=-2, axis2=-1), axis=-1)
    chosen = np.take_along_axis(products, best[..., None, None], -2)[..., 0, :]
    return np.asarray(chosen / np.linalg.norm(chosen, axis=-1, keepdims=True))


def rotation_from_quaternion(quaternion: ArrayLike) -> Array:
    """Rotations (..., 3, 3) of quaternions (..., 4) [qx qy qz qw]; they need not be of unit length."""
    q = np.asarray(quaternion, float)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    h = hat(q[..., :3])
    return np.asarray(np.eye(3) + 2 * q[..., 3, None, None] * h + 2 * (h @ h))


def rotation_from_euler(angles: ArrayLike) -> Array:
    """Rotations (..., 3, 3) of [alpha beta gamma] (..., 3), rad: Rz(gamma) @ Ry(beta) @ Rx(alpha), thesis Eq. 5.1-5.3.

    The thesis turns about one axis at a time and row vectors from the right (Eq. 5.5); the product below is the
    order in which its angles are recovered (Eq. 4.3), for column vectors.
    """
    angles = np.asarray(angles, float)
    (sa, sb, sg), (ca, cb, cg) = ([f(angles)[..., k] for k in range(3)] for f in (np.sin, np.cos))
    out = np.empty((*angles.shape, 3))
    out[..., 0, 0], out[..., 0, 1], out[..., 0, 2] = cg * cb, cg * sb * sa - sg * ca, cg * sb * ca + sg * sa
    out[..., 1, 0], out[..., 1, 1], out[..., 1, 2] = sg * cb, sg * sb * sa + cg * ca, sg * sb * ca - cg * sa
    out[..., 2, 0], out[..., 2, 1], out[..., 2, 2] = -sb, cb * sa, cb * ca
    return out


def euler_from_rotation(rotation: ArrayLike) -> Array:
    """[alpha beta gamma] (..., 3), rad, of rotations (..., 3, 3): thesis Eq. 4.3; at beta = +-pi/2 gamma is 0."""
    r = np.asarray(rotation, float)
    cos_y = np.hypot(r[..., 0, 0], r[..., 1, 0])
    y = np.arctan2(-r[..., 2, 0], cos_y)
    lock = cos_y < 1e-9
    x = np.where(lock, np.arctan2(-r[..., 1, 2], r[..., 1, 1]), np.arctan2(r[..., 2, 1], r[..., 2, 2]))
    z = np.where(lock, 0.0, np.arctan2(r[..., 1, 0], r[..., 0, 0]))
    return np.stack([x, y, z], axis=-1)
