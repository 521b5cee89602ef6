"""SE(3): the group laws, near identity, and the same numbers as gtsam.Pose3."""

from __future__ import annotations

import math

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation import se3
from estimation.pose import Trajectory
from estimation.se3 import Array


def vectors(size: int, bound: float) -> st.SearchStrategy[Array]:
    element = st.floats(-bound, bound, allow_nan=False, allow_subnormal=False)
    return st.lists(element, min_size=size, max_size=size).map(np.array)


@st.composite
def tangents(draw: st.DrawFn, angle: float = 3.1, length: float = 500.0) -> Array:
    """Tangent vectors whose rotation stays below pi; angles of 1e-12 rad come up as often as those of 1 rad."""
    axis = draw(vectors(3, 1.0).filter(lambda v: np.linalg.norm(v) > 1e-3))
    edges = st.sampled_from([0.0, 1e-12, 1e-9, 1e-6, 0.99e-4, 1.01e-4, 0.0499, 0.0501])
    size = draw(st.one_of(st.floats(0, angle), edges))
    return np.concatenate([axis / np.linalg.norm(axis) * size, draw(vectors(3, length))])


transforms = tangents().map(se3.exp)


def close(a: Array, b: Array, tolerance: float = 1e-9) -> bool:
    """Equal relative to the largest entry, at least 1."""
    return bool(np.abs(a - b).max() <= tolerance * max(1.0, np.abs(a).max(), np.abs(b).max()))


@given(tangents())
def test_log_undoes_exp(xi: Array) -> None:
    assert close(se3.log(se3.exp(xi)), xi)


@given(transforms)
def test_exp_undoes_log(t: Array) -> None:
    assert close(se3.exp(se3.log(t)), t)


@given(tangents())
def test_exp_of_minus_is_the_inverse(xi: Array) -> None:
    assert close(se3.exp(-xi), se3.inverse(se3.exp(xi)))


@given(transforms, transforms, transforms)
def test_the_group_laws(a: Array, b: Array, c: Array) -> None:
    assert close((a @ b) @ c, a @ (b @ c))
    assert close(a @ se3.inverse(a), np.eye(4))
    assert close(se3.inverse(a @ b), se3.inverse(b) @ se3.inverse(a))
    assert se3.is_transform(a @ b @ c)


@given(tangents(), st.floats(-2, 2), st.floats(-2, 2))
def test_one_parameter_subgroup(xi: Array, s: float, t: float) -> None:
    assert close(se3.exp(s * xi) @ se3.exp(t * xi), se3.exp((s + t) * xi))


@given(transforms, tangents(length=50.0))
def test_adjoint_moves_a_perturbation_to_the_other_side(t: Array, xi: Array) -> None:
    assert close(t @ se3.exp(xi) @ se3.inverse(t), se3.exp(se3.adjoint(t) @ xi))


@given(transforms, transforms)
def test_adjoint_is_a_homomorphism(a: Array, b: Array) -> None:
    assert close(se3.adjoint(a @ b), se3.adjoint(a) @ se3.adjoint(b))


@given(transforms, tangents(angle=3.0), st.floats(0, 1))
def test_interpolation_is_a_geodesic(a: Array, xi: Array, u: float) -> None:
    b = a @ se3.exp(xi)
    middle = se3.interpolate(a, b, u)
    assert close(se3.interpolate(a, b, 0.0), a)
    assert close(se3.interpolate(a, b, 1.0), b)
    assert close(middle, a @ se3.exp(u * xi), 1e-8)
    assert close(middle, se3.interpolate(b, a, 1 - u), 1e-8)


@given(transforms, tangents(angle=3.0), st.floats(0, 1))
def test_a_trajectory_goes_through_its_poses_and_stands_beyond_its_ends(a: Array, xi: Array, u: float) -> None:
    poses, stamps = np.stack([a, a @ se3.exp(xi), a]), np.array([1.0, 1.5, 2.5])
    known = Trajectory(stamps, poses, exact=True)
    assert close(known.at(stamps), poses) and close(known.at(np.array([0.0, 9.0])), poses[[0, 2]])
    assert close(known.at(np.array([1.0 + 0.5 * u]))[0], se3.interpolate(a, poses[1], u), 1e-8)


@given(tangents())
def test_exp_log_adjoint_and_inverse_are_gtsams(xi: Array) -> None:
    pose = gtsam.Pose3.Expmap(xi)
    assert close(se3.exp(xi), pose.matrix())
    assert close(se3.log(pose.matrix()), gtsam.Pose3.Logmap(pose), 1e-7)  # gtsam's log loses digits near pi
    assert close(se3.adjoint(pose.matrix()), pose.AdjointMap())
    assert close(se3.inverse(pose.matrix()), pose.inverse().matrix())


@given(tangents())
def test_log_of_one_is_log_of_a_stack(xi: Array) -> None:
    t = se3.exp(xi)
    for rows in (1, 40):  # few are taken one by one
        assert close(se3.log(t), se3.log(np.array([t] * rows))[-1])


@given(transforms, tangents(angle=3.0), st.floats(0, 1))
def test_interpolation_is_gtsams(a: Array, xi: Array, u: float) -> None:
    one, other = gtsam.Pose3(a), gtsam.Pose3(a @ se3.exp(xi))
    assert close(se3.interpolate(one.matrix(), other.matrix(), u), one.slerp(u, other).matrix(), 1e-8)


@given(tangents(angle=1e-3, length=1.0))
def test_near_identity_exp_is_its_series(xi: Array) -> None:
    twist = np.zeros((4, 4))
    twist[:3, :3], twist[:3, 3] = se3.hat(xi[:3]), xi[3:]
    series = sum((np.linalg.matrix_power(twist, n) / math.factorial(n) for n in range(1, 9)), np.eye(4))
    assert np.abs(se3.exp(xi) - series).max() < 1e-13


@pytest.mark.parametrize("size", [0.0, 1e-300, 1e-160, 1e-16, 1e-9, 1e-8])
def test_a_tiny_rotation_is_not_lost(size: float) -> None:
    xi = np.array([size, 0, 0, 1.0, 2.0, 3.0])
    back = se3.log(se3.exp(xi))
    assert np.allclose(back[3:], xi[3:], atol=1e-15) and back[0] == pytest.approx(size, rel=1e-6, abs=1e-16)


@pytest.mark.parametrize(
    "axis", [np.eye(3)[0], np.eye(3)[1], np.eye(3)[2], np.array([0.6, -0.8, 0.0]), np.ones(3) / 3**0.5]
)
@pytest.mark.parametrize("short_of_pi", [0.0, 1e-12, 1e-8, 1e-4])
def test_log_at_half_a_turn(axis: Array, short_of_pi: float) -> None:
    rotation = se3.exp_rotation(axis * (np.pi - short_of_pi))
    vector = se3.log_rotation(rotation)
    assert np.linalg.norm(vector) == pytest.approx(np.pi - short_of_pi, abs=1e-7)
    assert np.abs(se3.exp_rotation(vector) - rotation).max() < 1e-7


@given(transforms, vectors(4, 1.0).filter(lambda q: np.linalg.norm(q) > 1e-3))
def test_quaternions_round_trip(t: Array, q: Array) -> None:
    assert close(se3.rotation_from_quaternion(se3.quaternion_from_rotation(t[:3, :3])), t[:3, :3])
    back = se3.quaternion_from_rotation(se3.rotation_from_quaternion(q))
    unit = q / np.linalg.norm(q)
    assert min(np.abs(back - unit).max(), np.abs(back + unit).max()) < 1e-9


@given(vectors(3, np.pi), st.sampled_from([-np.pi / 2, np.pi / 2, None]))
def test_euler_angles_give_their_rotation_back(angles: Array, lock: float | None) -> None:
    angles = angles.copy()
    if lock is not None:
        angles[1] = lock  # gimbal lock: the angles are not unique, the rotation is
    rotation = se3.rotation_from_euler(angles)
    assert np.abs(se3.rotation_from_euler(se3.euler_from_rotation(rotation)) - rotation).max() < 2e-8


@given(transforms)
def test_nearest_rigid_motion_of_a_rigid_motion_is_itself(t: Array) -> None:
    assert close(se3.orthonormalise(t), t)
    noisy = t.copy()
    noisy[:3, :3] += 1e-3
    assert se3.is_transform(se3.orthonormalise(noisy), 1e-9)


@given(transforms, vectors(3, 1.0), vectors(9, 0.2))
def test_the_nearest_rotation_is_that_of_a_stretched_one_and_no_mirror(t: Array, stretch: Array, bend: Array) -> None:
    turn, skewed = t[:3, :3], np.eye(3) + bend.reshape(3, 3) / 2
    shape = skewed @ np.diag(1.5 + stretch / 2) @ skewed.T  # symmetric and positive
    many = se3.nearest_rotation(np.stack([turn @ shape, turn @ np.diag([1, 1, -0.1])]))
    assert np.allclose(many[0], turn, rtol=0, atol=1e-9)
    assert np.allclose(np.linalg.det(many), 1.0)


@given(transforms, vectors(3, 300.0))
def test_points_move_as_homogeneous_vectors(t: Array, point: Array) -> None:
    assert close(se3.transform_points(t, point[None])[0], (t @ np.append(point, 1.0))[:3])


@pytest.mark.parametrize("angle", [0.0, 1e-12, 9e-5, 1.1e-4, 0.049, 0.051, 1.0, 3.1, 20.0])
def test_one_vector_alone_gives_what_many_give(angle: float) -> None:
    xi = np.random.default_rng(2).normal(size=(40, 6))
    xi[:, :3] *= angle / np.linalg.norm(xi[:, :3], axis=1, keepdims=True)
    for one, among_many in zip(xi, se3.exp(xi), strict=True):
        assert np.allclose(se3.exp(one), among_many, rtol=0, atol=1e-13)


@pytest.mark.parametrize("shape", [(2, 5), (2, 2), (0, 3)])
def test_one_call_serves_any_shape(shape: tuple[int, int]) -> None:
    xi = np.random.default_rng(1).uniform(-1, 1, size=(*shape, 6))
    many = se3.exp(xi)
    assert many.shape == (*shape, 4, 4) and se3.log(many).shape == (*shape, 6)
    for i in np.ndindex(shape):
        assert np.allclose(many[i], se3.exp(xi[i]), rtol=0, atol=1e-14)  # one alone takes the short way
        assert np.allclose(se3.log(many)[i], xi[i])
        assert np.array_equal(se3.adjoint(many)[i], se3.adjoint(many[i]))


@pytest.mark.parametrize("rows", [3, 40])
@pytest.mark.filterwarnings("ignore:invalid value")
def test_what_is_not_finite_stays_in_its_row(rows: int) -> None:
    xi = np.full((rows, 6), 0.1)
    whole, xi[1] = se3.exp(xi), np.inf
    spoiled = se3.exp(xi)
    assert not np.isfinite(spoiled[1]).all() and np.array_equal(np.delete(spoiled, 1, 0), np.delete(whole, 1, 0))
    assert np.isfinite(np.delete(se3.log(spoiled), 1, 0)).all()


@pytest.mark.parametrize(
    "spoil",
    [
        lambda t: t * np.nan, lambda t: t @ np.diag([1, 1, -1, 1]), lambda t: t @ np.diag([1.001, 1, 1, 1]),
        lambda t: t + np.eye(4)[3][:, None] * 1e-3, lambda t: t[:3], lambda t: t @ np.diag([1e200, 1, 1, 1]),
    ],
)  # fmt: skip
@pytest.mark.filterwarnings("error")
def test_what_is_not_a_rigid_motion_is_told(spoil) -> None:
    t = se3.exp(np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0]))
    assert se3.is_transform(t) and not se3.is_transform(spoil(t))
