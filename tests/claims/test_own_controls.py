"""Control sets of a user whose `minimise` or `project` leaves the set of `contains`: none is certified."""

import pytest
import torch

from lyapnet.base.errors import UsageError
from lyapnet.claims.control_sets import check_controls
from lyapnet.loop.rollout import ClosedLoop
from lyapnet.task.sets import ControlSet
from lyapnet.task.systems import Linear
from lyapnet.value.policy import HJBPolicy
from tests.claims.test_false_attempts import Bowl, claim
from tests.problems import problem_of

A = [[-1.0, 0.3], [0.0, -1.0]]
DOMAIN = torch.tensor([0.0, -1.5, -1.5]).double(), torch.tensor([1.0, 1.5, 1.5]).double()
LIMITS = torch.tensor([-1.0, -1.0]), torch.tensor([1.0, 1.0])


class Limits(ControlSet):
    """|u_i| ≤ 1, for a diagonal R."""

    def minimise(self, R, b):
        return self.project(-0.5 * b / R.diagonal(dim1=-2, dim2=-1))

    def contains(self, u):
        return (u.abs() <= 1).all(-1)

    def project(self, u):
        return u.clamp(-1, 1)


class TwoSided(Limits):
    def contains(self, u):
        return ((u >= -1) & (u <= 1)).all(-1) & torch.isfinite(u).all(-1)

    def project(self, u):
        return torch.maximum(torch.minimum(u, LIMITS[1].to(u)), LIMITS[0].to(u))


class Disk(Limits):
    """‖u‖ ≤ 1."""

    def contains(self, u):
        return (u**2).sum(-1) <= 1

    def project(self, u):
        return u / (u**2).sum(-1, keepdim=True).clamp_min(1).sqrt()


class Wide(Limits):
    def minimise(self, R, b):
        return (-0.5 * b).clamp(-1.2, 1.2)


class Spike(Limits):
    """It leaves U where b lies in an interval of 10⁻⁴."""

    def minimise(self, R, b):
        return super().minimise(R, b) * (1 + 0.5e4 * torch.relu(1e-4 - (b[..., :1] - 1.93).abs()))


class FarAway(Limits):
    """It leaves U in two corners."""

    def minimise(self, R, b):
        return super().minimise(R, b) * torch.where(b > 5.95, 1.1, 1.0)


class OneSide(Limits):
    def project(self, u):
        return u.clamp_min(-1)


class Narrow(Limits):
    """The set of `contains` is smaller than that of `project`."""

    def contains(self, u):
        return (u.abs() <= 0.99).all(-1)


class OfTheSum(Limits):
    def contains(self, u):
        return super().contains(u) & (u.sum(-1) <= 1.9)


class Either(Limits):
    """The two halves of a box, without the middle."""

    def contains(self, u):
        return super().contains(u) & ((u[..., 0] >= 0.1) | (u[..., 0] <= -0.1))


class Unequal(Limits):
    """u ≠ 7 has no margin."""

    def contains(self, u):
        return super().contains(u) & (u != 7).all(-1)


class SmallDisk(Disk):
    def contains(self, u):
        return (u**2).sum(-1) <= 0.98


class Reading(Limits):
    def contains(self, u):
        return torch.as_tensor(abs(u.detach().numpy()) <= 1).all(-1)


class Rounded(Limits):
    def minimise(self, R, b):
        return super().minimise(R, b) - 2e-6 * b


class Turned(Limits):
    """The result is rotated."""

    def minimise(self, R, b):
        u = super().minimise(R, b)
        return torch.stack([0.8 * u[..., 0] - 0.6 * u[..., 1], 0.6 * u[..., 0] + 0.8 * u[..., 1]], -1)


def assumed(controls):
    """The assumption about u = clamp(−2x) on D."""
    problem = problem_of(Linear(A, torch.eye(2)), controls=controls)
    return check_controls(ClosedLoop(problem, HJBPolicy(problem, Bowl())).double(), DOMAIN)


@pytest.mark.parametrize("controls", [Limits, TwoSided])
def test_what_keeps_to_its_set_is_proved(controls):
    """The counterparts."""
    assert not assumed(controls())


@pytest.mark.parametrize("controls", [Disk, Unequal])
def test_what_bounds_do_not_decide_is_said(controls, caplog):
    assert "tested at 20000 points of [0, T] × D, and is not proved" in assumed(controls())
    assert "not proved" in caplog.text


@pytest.mark.parametrize(
    "controls",
    [Wide, Spike, FarAway, OneSide, Narrow, OfTheSum, Either, SmallDisk, Reading, Rounded, Turned],
)
def test_what_leaves_its_set_is_refused(controls):
    with pytest.raises(UsageError, match="contains") as error:
        assumed(controls())
    assert len(str(error.value).splitlines()) == 1


class OfOne(Limits):
    """A set for one control; u leaves U at `leave`."""

    def __init__(self, leave):
        super().__init__()
        self.leave = leave

    def minimise(self, R, b):
        return super().minimise(R, b) * (1 + self.leave(b))


@pytest.mark.gate
def test_certificates_look_at_it():
    with pytest.raises(UsageError, match=r"Expected OfOne\.minimise\(R, b\) in the set that contains\(u\) describes"):
        claim(controls=OfOne(lambda b: 1e4 * torch.relu(1e-4 - (b - 1.93).abs())))
