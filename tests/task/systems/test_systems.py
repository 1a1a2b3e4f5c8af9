"""Facts that every registered system declares, each by an independent route, and broken systems that fail them."""

import math
from functools import partial

import numpy as np
import pytest
import sympy
import torch
from scipy.integrate import solve_ivp
from torch.testing import assert_close

from lyapnet.base.errors import UsageError
from lyapnet.task.systems import (
    SYSTEMS,
    Acrobot,
    BodyFrameQuadrotor,
    Cartpole,
    DoubleIntegrator,
    Glider,
    Linear,
    MechanicalSystem,
    PathTracking,
    Quadrotor,
    Reacher,
    Rocket,
    Satellite,
    ThreeLinkArm,
)
from lyapnet.task.systems.base import ControlAffineSystem

ENERGETIC = [name for name, cls in SYSTEMS.items() if hasattr(cls, "energy")]
MECHANICAL = [name for name, cls in SYSTEMS.items() if issubclass(cls, MechanicalSystem)]


def draw(system, *batch):
    return torch.randn(*batch, system.n), torch.randn(*batch, system.m)


def maps_of(system):
    """Every function of the state that the system offers."""
    declared = [
        *([system.f, system.g] if system.affine else []),
        getattr(system, "energy", None),
        getattr(system, "inverse_mass", None),
    ]
    return [function for function in declared if function]


# Each check is a fact about one system.


@pytest.fixture(params=SYSTEMS)
def system(request, build_system):
    """Each registered system in turn, whose dynamics may be affine in the control or not."""
    return build_system(request.param)


def is_affine_in_the_control(system):
    """Or says that it is not: then f and g are refused by name."""
    x, u = draw(system, 6)
    if not system.affine:
        assert not torch.allclose(system.dynamics(x, 2 * u) + system.dynamics(x, 0 * u), 2 * system.dynamics(x, u))
        for refused in (system.f, system.g):
            with pytest.raises(UsageError, match=f"control-affine system with f.*got {type(system).__name__}"):
                refused(x)
        return
    v = torch.randn_like(u)
    assert_close(system.dynamics(x, u), system.f(x) + torch.einsum("bnm,bm->bn", system.g(x), u))
    assert_close(system.dynamics(x, u) + system.dynamics(x, v), system.dynamics(x, u + v) + system.f(x))


def acts_on_each_state_alone(system):
    sizes = range(system.n + 2)  # none, and as many states as a matrix of the system has rows
    for batch in ((), *((size,) for size in sizes), (3, 2)):
        x, u = draw(system, *batch)
        for function, arguments in ((system.dynamics, (x, u)), *((function, (x,)) for function in maps_of(system))):
            whole = function(*arguments)
            assert whole.shape[: len(batch)] == batch
            for i in np.ndindex(*batch):
                assert_close(whole[i], function(*(v[i] for v in arguments)))


def is_differentiable(system):
    arguments = [v.requires_grad_() for v in draw(system, 3)]
    assert torch.autograd.gradcheck(system.dynamics, arguments, raise_exception=False)
    for function in maps_of(system):
        assert torch.autograd.gradcheck(function, arguments[:1], raise_exception=False)


def rests_at_the_origin(system):
    """Without control; on a circle, with the steering that goes round it; a rocket hovers."""
    u = torch.tensor([0.1]) if isinstance(system, PathTracking) else torch.zeros(system.m)
    x = torch.zeros(system.n)
    if isinstance(system, Rocket):
        u[-1] = system.gravity
    if isinstance(system, Glider):  # down a slope of drag/lift, as fast as the force of the air equals the weight
        u[0] = 0.1
        lift = system.lift_slope * u
        drag = system.drag + system.induced * lift**2
        pressure = system.mass * system.gravity / torch.hypot(lift, drag) / (system.density * system.area / 2)
        x = torch.cat([pressure.sqrt(), -torch.atan(drag / lift)])
    assert_close(system.dynamics(x, u), torch.zeros(system.n))


def names_its_coordinates(system):
    assert len(system.state_names) == len(system.state_units) == system.n == len(set(system.state_names)) > 0
    assert len(system.control_names) == len(system.control_units) == system.m == len(set(system.control_names)) > 0
    assert tuple(system.angles) == tuple(i for i, unit in enumerate(system.state_units) if unit == "rad")


def returns_after_a_turn(system):
    x, u = draw(system, 6)
    for i in system.angles:
        turned = x + 2 * math.pi * torch.eye(system.n)[i]
        assert_close(system.dynamics(turned, u), system.dynamics(x, u))


def keeps_the_precision(system):
    system = system.float()
    x, u = (v.float() for v in draw(system, 2))
    assert {v.dtype for v in (system.dynamics(x, u), *(function(x) for function in maps_of(system)))} == {torch.float32}


# check: what turns the double integrator into a system that fails it
CHECKS = {
    is_affine_in_the_control: {"dynamics": lambda x, u: x + u**2},
    acts_on_each_state_alone: {"f": lambda x: x - x.mean()},
    is_differentiable: {"dynamics": lambda x, u: x.detach() * u},
    rests_at_the_origin: {"dynamics": lambda x, u: torch.ones_like(x)},
    names_its_coordinates: {"state_units": ("m",)},
    returns_after_a_turn: {"angles": (1,)},
    keeps_the_precision: {"f": torch.Tensor.double},
}


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_every_system(system, check):
    check(system)


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_each_check_can_fail(check):
    broken = DoubleIntegrator()
    for name, value in CHECKS[check].items():
        setattr(broken, name, value)
    with pytest.raises(AssertionError):
        check(broken)


def test_no_digits_are_lost_where_single_precision_is_the_default(system):
    loses_no_digits(system)


@pytest.mark.parametrize("make", [partial(PathTracking, speed=2.1), partial(BodyFrameQuadrotor, mass=1.1)])
def test_no_digits_of_parameters_are_lost_either(make):
    loses_no_digits(make())


def loses_no_digits(system):
    x = draw(system, 6)[0]
    expected = [function(x) for function in maps_of(system)]
    torch.set_default_dtype(torch.float32)
    for function, value in zip(maps_of(system), expected, strict=True):
        assert_close(function(x), value, rtol=1e-13, atol=1e-13)


def test_a_registered_system_that_cannot_be_built_fails(monkeypatch, build_system):
    class Unlisted(DoubleIntegrator):
        def __init__(self, undeclared: float):
            super().__init__(undeclared)

    monkeypatch.setitem(SYSTEMS, "unlisted", Unlisted)
    with pytest.raises(pytest.fail.Exception, match="Expected arguments for 'unlisted'"):
        build_system("unlisted")


# Energy


def without_friction(system):
    if isinstance(system, MechanicalSystem):
        damp(system, torch.zeros(system.n // 2))
    return system


def damp(system, damping):
    """Give a system another damping of each rate; returns it, as one parameter may be that of several."""
    system.D.copy_(damping)
    for name, value in zip(system.dampings, damping.tolist(), strict=False):
        setattr(system, name, value)
    return torch.tensor([getattr(system, name) for name in system.dampings]) if system.dampings else damping


def power(system, x, u):
    """Ė = E_xᵀẋ."""
    x = x.requires_grad_()
    (slope,) = torch.autograd.grad(system.energy(x).sum(), x)
    return (slope * system.dynamics(x, u)).sum(-1)


def drift_of_energy(system, seconds=2.0):
    """Relative change of the energy along u = 0, by an integrator of scipy at tight tolerance."""
    x0 = torch.randn(system.n)
    rest = torch.zeros(system.m)

    def slope(_, x):
        return system.dynamics(torch.from_numpy(x), rest).numpy()

    path = solve_ivp(slope, (0, seconds), x0.numpy(), "DOP853", rtol=1e-11, atol=1e-12).y.T
    energy = system.energy(torch.tensor(path))
    return float((energy - energy[0]).abs().max() / energy.abs().max())


@pytest.mark.parametrize("system", ENERGETIC, indirect=True)
def test_energy_is_conserved_without_friction_and_control(system):
    system = without_friction(system)
    x, u = draw(system, 50)
    assert_close(power(system, x, 0 * u), torch.zeros(50), atol=1e-10, rtol=0)
    assert drift_of_energy(system) < 1e-8


@pytest.mark.parametrize("system", MECHANICAL, indirect=True)
def test_friction_and_control_change_the_energy_by_their_power(system):
    """Ė = q̇ᵀBu − q̇ᵀDq̇; with friction alone the conservation test fails."""
    D = damp(system, torch.linspace(0.1, 0.3, system.n // 2))
    x, u = draw(system, 50)
    qdot = x[:, system.n // 2 :]
    assert_close(power(system, x, u), (qdot * (u @ system.B.mT)).sum(-1) - (D * qdot**2).sum(-1))
    assert drift_of_energy(system) > 1e-3


class ReleasedReacher(Reacher):
    """The authors' code: another a₂ in the Coriolis force than in M."""

    def forces(self, q, qdot):
        return super().forces(q, qdot) * (0.03 / self.a2)


def test_two_different_a2_create_energy():
    system = without_friction(ReleasedReacher())
    x, u = draw(system, 50)
    assert power(system, x, 0 * u).abs().max() > 1e-2
    assert drift_of_energy(system) > 1e-3


@pytest.mark.parametrize("system", MECHANICAL, indirect=True)
def test_mass_matrix_is_positive_definite_and_inverse_mass_is_its_inverse(system):
    q = 4 * torch.randn(100, system.n // 2)
    M = system.mass_matrix(q)
    assert_close(M, M.mT)
    assert (torch.linalg.eigvalsh(M) > 0).all()
    B, weights = system.B.numpy(), system.inverse_mass(torch.cat([q, torch.zeros_like(q)], -1)).numpy()
    for inverse_mass, mass in zip(weights, M.numpy(), strict=True):
        np.testing.assert_allclose(inverse_mass, B.T @ np.linalg.inv(mass) @ B, rtol=1e-10)


# Dynamics against the Euler–Lagrange equations of the geometry

q1, q2, v1, v2, u1, u2 = SYMBOLS = sympy.symbols("q1 q2 v1 v2 u1 u2")


def velocity(position):
    return sympy.Matrix(position).jacobian([q1, q2]) * sympy.Matrix([v1, v2])


def moving(mass, position):
    """½ m‖ṗ‖² of a point mass."""
    return mass * velocity(position).dot(velocity(position)) / 2


def lagrangian_dynamics(lagrangian, forces):
    """(x, u) ↦ ẋ from d/dt L_v − L_q = forces, solved for the accelerations and evaluated in numpy."""
    q, v = sympy.Matrix([q1, q2]), sympy.Matrix([v1, v2])
    momentum = sympy.Matrix([lagrangian]).jacobian(v)
    force = sympy.Matrix(forces) + sympy.Matrix([lagrangian]).jacobian(q).T - momentum.jacobian(q) * v
    evaluate = sympy.lambdify(SYMBOLS, [momentum.jacobian(v), force])

    def dynamics(x, u):
        M, h = evaluate(*x, *u, *[0.0] * (2 - len(u)))
        return np.concatenate([x[2:], np.linalg.solve(M, h)[:, 0]])

    return dynamics


def cartpole_by_geometry(cart_mass=1.0, pole_mass=1.0, length=1.0, friction=(0.0, 0.1)):
    tip = (q1 + length * sympy.sin(q2), length * sympy.cos(q2))
    kinetic = moving(cart_mass, (q1, 0)) + moving(pole_mass, tip)
    return lagrangian_dynamics(kinetic - pole_mass * 9.81 * tip[1], (u1 - friction[0] * v1, -friction[1] * v2))


def reacher_by_geometry(elbow_offset=0.16, friction=0.25):
    """Two rigid links: the second of mass 1 kg, centre of mass 0.16 m after the elbow at 0.3 m, inertias about the
    centres of mass such that a₁ = 0.196, a₂ = 1·0.3·0.16 and a₃ = 0.045."""
    mass1, centre1, mass2, centre2, upper = 1.4, 0.11, 1.0, elbow_offset, 0.3
    inertia2 = 0.045 - mass2 * centre2**2
    inertia1 = 0.196 - 0.045 - mass2 * upper**2 - mass1 * centre1**2
    assert inertia1 > 0 < inertia2

    def along(angle, distance):
        return sympy.Matrix([distance * sympy.cos(angle), distance * sympy.sin(angle)])

    kinetic = moving(mass1, along(q1, centre1)) + moving(mass2, along(q1, upper) + along(q1 + q2, centre2))
    rotation = inertia1 * v1**2 / 2 + inertia2 * (v1 + v2) ** 2 / 2
    return lagrangian_dynamics(kinetic + rotation, (u1 - friction * v1, u2 - friction * v2))


def acrobot_by_geometry(length=1.0, friction=0.1):
    """Two uniform rods, of angles from upright, as points at their centres with an inertia about them."""

    def along(angle, distance):
        return sympy.Matrix([distance * sympy.sin(angle), distance * sympy.cos(angle)])

    first, second = along(q1, length / 2), along(q1, length) + along(q1 + q2, length / 2)
    rotation = length**2 / 12 * (v1**2 + (v1 + v2) ** 2) / 2
    height = first[1] + second[1]
    kinetic = moving(1.0, first) + moving(1.0, second) + rotation
    return lagrangian_dynamics(kinetic - 9.81 * height, (-friction * v1, u1 - friction * v2))


def matches_geometry(system, dynamics):
    x, u = draw(system, 20)
    expected = np.stack([dynamics(*pair) for pair in zip(x.numpy(), u.numpy(), strict=True)])
    np.testing.assert_allclose(system.dynamics(x, u).numpy(), expected, rtol=1e-9, atol=1e-9)


BALANCING = {"cart_mass": 1.0, "pole_mass": 0.1, "length": 0.3}


@pytest.mark.parametrize(
    ("system", "geometry"),
    [
        pytest.param(Cartpole, cartpole_by_geometry, id="swing-up"),
        pytest.param(
            partial(Cartpole, **BALANCING, cart_damping=0.1),
            partial(cartpole_by_geometry, **BALANCING, friction=(0.1, 0.1)),
            id="balancing",
        ),
        pytest.param(Reacher, reacher_by_geometry, id="reacher"),
        pytest.param(Acrobot, acrobot_by_geometry, id="acrobot"),
    ],
)
def test_dynamics_follow_from_the_lagrangian(system, geometry):
    matches_geometry(system(), geometry())


@pytest.mark.parametrize(
    ("system", "geometry"),
    [
        pytest.param(Cartpole, partial(cartpole_by_geometry, length=1.01), id="length"),
        pytest.param(Cartpole, partial(cartpole_by_geometry, friction=(0.1, 0.0)), id="friction"),
        pytest.param(Reacher, partial(reacher_by_geometry, elbow_offset=0.15), id="a2"),
        pytest.param(ReleasedReacher, reacher_by_geometry, id="coriolis"),
        pytest.param(Acrobot, partial(acrobot_by_geometry, length=1.01), id="rod"),
        pytest.param(Acrobot, partial(acrobot_by_geometry, friction=0.11), id="joints"),
    ],
)
def test_another_geometry_does_not_match(system, geometry):
    with pytest.raises(AssertionError):
        matches_geometry(system(), geometry())


def test_linear_systems_against_numbers_by_hand():
    x, u = torch.tensor([1.0, 2.0]), torch.tensor([3.0])
    assert DoubleIntegrator(mass=2.0).dynamics(x, u).tolist() == [2.0, 1.5]
    assert DoubleIntegrator(mass=2.0).energy(x) == 4.0
    assert DoubleIntegrator(mass=2.0).inverse_mass(x).tolist() == [[0.5]]
    linear = Linear([[1.0, 2.0], [3.0, 4.0]], [[5.0], [6.0]])
    assert linear.f(x).tolist() == [5.0, 11.0]
    assert linear.g(x).tolist() == [[5.0], [6.0]]
    assert linear.dynamics(x, u).tolist() == [20.0, 29.0]


SQUARE, COLUMN = [[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]]


@pytest.mark.parametrize(
    ("system", "arguments"),
    [
        *((DoubleIntegrator, {"mass": value}) for value in (0.0, -1.0, math.nan, math.inf)),
        *((Cartpole, {name: 0.0}) for name in ("cart_mass", "pole_mass", "length")),
        *((Cartpole, {name: -0.1}) for name in ("cart_damping", "pole_damping")),
        *((Cartpole, {name: math.nan}) for name in ("length", "pole_damping", "gravity")),
        *((Reacher, {name: -1.0}) for name in ("a1", "a2", "a3", "damping")),
        *((Acrobot, {name: 0.0}) for name in ("mass", "length", "gravity")),
        *((ThreeLinkArm, {name: 0.0}) for name in ("mass", "length")),
        *((Quadrotor, {name: -1.0}) for name in ("mass", "gravity")),
        *((BodyFrameQuadrotor, {"inertia": value}) for value in ((1.0, 0.0, 1.0), (1.0, 1.0))),
        *((Satellite, {"inertia": value}) for value in ((2.0, 3.0, -4.0), (1.0, 1.0, 1.0, 1.0))),
        (Satellite, {"momentum": (1.0, 1.0)}),
        (Reacher, {"a2": 0.1}),  # no positive definite mass matrix
        (Linear, {"A": [[0.0, 1.0]], "B": COLUMN}),
        (Linear, {"A": SQUARE, "B": [[1.0]]}),
        (Linear, {"A": torch.zeros(2), "B": COLUMN}),
        (Linear, {"A": SQUARE, "B": torch.zeros(2)}),
        (Linear, {"A": [[0.0, 1.0], [0.0]], "B": COLUMN}),
        (Linear, {"A": [[0.0, math.nan], [0.0, 0.0]], "B": COLUMN}),
    ],
)
def test_parameters_without_meaning_are_refused(system, arguments):
    with pytest.raises(ValueError, match="Expected"):
        system(**arguments)


def test_a_user_system_needs_only_f_g_and_its_names():
    class Pendulum(ControlAffineSystem):
        state_names, state_units = ("angle", "velocity"), ("rad", "rad/s")
        control_names, control_units = ("torque",), ("N·m",)
        angles = (0,)

        def f(self, x):
            return torch.stack([x[..., 1], torch.sin(x[..., 0])], -1)

        def g(self, x):
            return torch.tensor([[0.0], [1.0]]).to(x).expand(*x.shape[:-1], 2, 1)

    for check in CHECKS:
        check(Pendulum())
