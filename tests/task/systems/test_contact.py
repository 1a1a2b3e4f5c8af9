"""Contact: limits and slopes of the forces, what they do to energy, and their names in equations."""

import pytest
import torch
from torch.testing import assert_close

from lyapnet import friction_force, normal_force
from lyapnet.base.errors import UsageError
from lyapnet.task.systems.equations import defined

STIFFNESS, LENGTH = 1000.0, 0.01
GAPS = torch.linspace(-3 * LENGTH, 3 * LENGTH, 6001, dtype=torch.float64)
STILL = torch.zeros_like(GAPS)
BALL = """
normal = normal_force(height, speed, stiffness, damping, length)
der(height) = speed
der(speed) = push + normal - 9.81
"""


def slopes(function, x, order):
    """Derivatives by x of the orders 1 … order."""
    x, found = x.clone().requires_grad_(), []
    y = function(x)
    for _ in range(order):
        (y,) = torch.autograd.grad(y.sum(), x, create_graph=True)
        found.append(y.detach())
    return found


def mean_over_blur(function, x, width):
    """E f(x + wξ) with ξ of density ¾(1 − ξ²), by the midpoint rule."""
    xi = (torch.arange(2000, dtype=torch.float64) + 0.5) / 1000 - 1
    return (function(x[:, None] + width * xi) * 0.75 * (1 - xi**2)).sum(1) / 1000


def ball(damping, length=1e-4, stiffness=1e4):
    values = {"stiffness": stiffness, "damping": damping, "length": length}
    return defined(BALL, {"height": "m", "speed": "m/s"}, {"push": "N"}, list(values))(**values)


def energy_after_a_bounce(system, speed, dt=2e-5, gravity=9.81):
    """The energy of a ball of 1 kg that falls from 0.01 m at a speed, once it is back."""
    x = torch.tensor([0.01, -speed], dtype=torch.float64)
    u = torch.zeros(1, dtype=torch.float64)
    while x[0] < 0.0101:
        half = x + dt / 2 * system.dynamics(x, u)
        x = x + dt * system.dynamics(half, u)
    return float(gravity * x[0] + x[1] ** 2 / 2)


def test_the_normal_force_is_the_sharp_one_beyond_its_length_and_near_it_within():
    sharp, force = STIFFNESS * torch.relu(-GAPS), normal_force(GAPS, STILL, STIFFNESS, 0.0, LENGTH)
    beyond = GAPS.abs() >= LENGTH
    assert_close(force[beyond], sharp[beyond], rtol=1e-12, atol=1e-12)
    error = (force - sharp)[~beyond]
    assert error.min() >= 0
    assert_close(error.max(), torch.tensor(3 * STIFFNESS * LENGTH / 16).double(), rtol=1e-6, atol=0)


def test_both_forces_are_means_of_the_sharp_ones_over_a_blur():
    mean = mean_over_blur(lambda d: STIFFNESS * torch.relu(-d), GAPS[::100], LENGTH)
    assert_close(normal_force(GAPS, STILL, STIFFNESS, 0.0, LENGTH)[::100], mean, rtol=0, atol=1e-4)
    mean = mean_over_blur(lambda v: -0.3 * 5 * torch.sign(v), GAPS[::100], LENGTH)
    assert_close(friction_force(GAPS, 0 * GAPS + 5, 0.3, LENGTH)[::100], mean, rtol=0, atol=2e-3)


def test_slopes_are_bounded_and_two_of_them_continuous():
    first, second = slopes(lambda d: normal_force(d, STILL, STIFFNESS, 0.0, LENGTH), GAPS, 2)
    assert first.max() <= 0
    assert first.min() >= -STIFFNESS * (1 + 1e-12)
    largest = 0.75 * STIFFNESS / LENGTH  # of the bend
    assert second.max() <= largest * (1 + 1e-12)
    assert second.diff().abs().max() < 0.01 * largest  # nowhere a jump
    (slope,) = slopes(lambda v: friction_force(v, 0 * v + 5, 0.3, LENGTH), GAPS, 1)
    assert_close(slope.min(), torch.tensor(-1.5 * 0.3 * 5 / LENGTH).double())
    assert slope.diff().abs().max() < 0.01 * -slope.min()


def test_second_derivatives_of_a_hard_friction_jump():
    (slope,) = slopes(lambda v: friction_force(v, 0 * v + 5, 0.3, 1e-9), GAPS + 1e-12, 1)
    assert slope.diff().abs().max() > 0.9 * slope.abs().max()


def test_contact_never_pulls_and_friction_never_drives():
    gap, rate = 0.1 * torch.randn(2, 100_000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    force = normal_force(gap, 100 * rate, STIFFNESS, 0.3, LENGTH)
    assert force.min() >= 0
    assert (force[gap > LENGTH] == 0).all()
    assert (friction_force(rate, force, 0.5, LENGTH) * rate).max() <= 0
    assert (STIFFNESS * torch.relu(-gap) - 30 * 100 * rate).min() < 0  # as a spring and a damper without a clamp do


@pytest.mark.parametrize("damping", [0.0, 0.05, 0.2])
def test_energy_never_grows_in_a_bounce(damping):
    before, after = 9.81 * 0.01 + 2.0, energy_after_a_bounce(ball(damping), 2.0)
    assert after <= before * (1 + 1e-6)
    if not damping:
        assert after > before * (1 - 1e-4)
    else:
        meets = (2.0**2 + 2 * 9.81 * 0.01) ** 0.5
        leaves = (2 * after) ** 0.5
        assert leaves / meets == pytest.approx(1 - 2 / 3 * damping * meets, abs=damping**2 * meets**2)


def test_energy_grows_with_a_damper_of_the_wrong_sign():
    assert energy_after_a_bounce(ball(-0.05), 2.0) > 9.81 * 0.01 + 2.0 + 0.1


def test_small_loads_creep():
    speed, load = 0.02, 0.1
    slip = torch.tensor(2 / 3 * speed * load / (0.5 * 10), dtype=torch.float64)
    assert_close(-friction_force(slip, torch.tensor(10.0), 0.5, speed), torch.tensor(load).double(), rtol=1e-3, atol=0)


def test_equations_have_both_by_name():
    text = (
        "normal = normal_force(x, y, 100, damping, 0.2)\nder(x) = u + friction_force(y, normal, 0.4, 0.1)\n"
        "der(y) = 2*normal_force(0.1 - 0.15, 0, 100, 0, 0.01)"
    )
    system = defined(text, dict.fromkeys("xy", ""), {"u": ""}, ["damping"])(damping=0.3)
    x, y = points = torch.randn(2, 50, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = system.dynamics(points.mT, torch.ones(50, 1, dtype=torch.float64))
    assert system.affine
    assert_close(found[:, 0], 1 + friction_force(y, normal_force(x, y, 100.0, 0.3, 0.2), 0.4, 0.1))
    assert_close(found[:, 1], torch.full_like(x, 10.0))


@pytest.mark.parametrize("text", ["normal_force(x, y, 100, 0, 0)", "friction_force(x, y, 1, -0.1)"])
def test_no_length_is_refused(text):
    system = defined(f"der(x) = {text}\nder(y) = u", dict.fromkeys("xy", ""), {"u": ""})()
    with pytest.raises(
        UsageError, match=r"Expected a positive smoothing (length|speed) of contact, got -?0\.[01]; .+\."
    ):
        system.f(torch.zeros(2))
