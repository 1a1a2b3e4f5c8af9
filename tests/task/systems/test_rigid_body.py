"""Rigid bodies in space, against scipy's rotations, and the motion of a rotation matrix."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

from lyapnet.task.systems import BodyFrameQuadrotor, Quadrotor, Satellite
from lyapnet.task.systems.rigid_body import attitude_rates, cross, to_body_frame


@pytest.fixture
def attitude():
    return 1.2 * torch.rand(20, 3) - 0.6


def of_scipy(attitude, order="ZYX"):
    """Rows roll, pitch, yaw; the rotation of the body's frame, or that of another order of the angles."""
    turned = Rotation.from_euler(order, attitude.numpy()[:, ::-1])
    return torch.from_numpy(turned.as_matrix())


def skew(w):
    return torch.stack([cross(w, e.expand_as(w)) for e in torch.eye(3)], -1)


def moving(attitude, rates):
    """d/dt of the rotation from the body's frame."""
    return torch.autograd.functional.jvp(lambda angles: to_body_frame(angles).mT, attitude, rates)[1]


def test_the_rotation_is_that_of_scipy(attitude):
    assert_close(to_body_frame(attitude).mT, of_scipy(attitude))
    with pytest.raises(AssertionError):
        assert_close(to_body_frame(attitude).mT, of_scipy(attitude, "XYZ"))


def test_rates_move_the_rotation_by_their_cross_product(attitude):
    """Ċ = C [w]× for the rotation C from the body's frame and rates w in it."""
    w = torch.randn(20, 3)
    turned = to_body_frame(attitude).mT @ skew(w)
    assert_close(moving(attitude, attitude_rates(attitude, w)), turned)
    with pytest.raises(AssertionError):
        assert_close(moving(attitude, w), turned)


def test_a_quadrotor_in_its_own_frame_moves_as_seen_from_the_ground(attitude):
    """m p̈ = thrust along the body's axis less the weight, for any rates; and J ẇ + w × J w = torques."""
    system = BodyFrameQuadrotor()
    v, w, u = torch.randn(20, 3), torch.randn(20, 3), torch.randn(20, 4)
    x = torch.cat([torch.randn(20, 3), v, attitude, w], -1)
    xdot = system.dynamics(x, u)
    rotation, turn = to_body_frame(attitude).mT, moving(attitude, xdot[:, 6:9])
    assert_close(xdot[:, :3], (rotation @ v[..., None])[..., 0])
    acceleration = (rotation @ xdot[:, 3:6, None] + turn @ v[..., None])[..., 0]
    thrust = (system.gravity + u[:, :1] / system.mass) * rotation[..., 2]
    assert_close(acceleration, thrust - torch.tensor([0.0, 0.0, system.gravity]))
    torque = system.inertia * xdot[:, 9:] + cross(w, system.inertia * w)
    assert_close(torque, u[:, 1:])


def test_the_momentum_of_a_free_satellite_with_its_wheels_is_kept():
    """d/dt (C J w) = −C (w × Jw) + …: with wheels of momentum h at rest in space, J ẇ = −w × (R h) and u = 0."""
    system = Satellite()
    x = torch.cat([1.2 * torch.rand(20, 3) - 0.6, torch.randn(20, 3)], -1)
    w, h = x[:, 3:], to_body_frame(x[:, :3]) @ system.momentum
    assert_close(system.inertia * system.f(x)[:, 3:], -cross(w, h))
    power = (w * system.inertia * system.f(x)[:, 3:]).sum(-1)
    assert_close(power, torch.zeros(20), atol=1e-12, rtol=0)


def test_a_quadrotor_accelerates_along_its_axis(attitude):
    x, u = torch.randn(20, 12), torch.randn(20, 4)
    x[:, 3:6] = attitude
    axis = torch.from_numpy(of_scipy(attitude).numpy()[..., 2])
    for carried in (0.0, 1.0):
        system = Quadrotor(mass=2.0, carried=carried)
        weight = torch.tensor([0.0, 0.0, system.gravity])
        expected = (u[:, :1] / 2 + carried * system.gravity) * axis - weight
        assert_close(system.dynamics(x, u)[:, 6:9], expected)
        assert_close(system.dynamics(x, u)[:, 9:], u[:, 1:])
    assert Quadrotor().f(torch.zeros(12)).abs().max() == 0
    assert math.isclose(float(Quadrotor(carried=0.0).f(torch.zeros(12))[8]), -9.81)
    assert np.allclose(x[:, 6:9], Quadrotor().f(x)[:, :3])
