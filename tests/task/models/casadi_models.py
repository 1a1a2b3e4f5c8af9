"""Twelve CasADi models with tasks, rewritten from the equations of their sources, and four robots.

`train_casadi_models` trains them. Weights, X₀, limits and horizons are what an engineer would write down before seeing
any result.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import casadi
from casadi import MX, SX, Function, cos, exp, sin, sqrt, tan, tanh, vertcat


class Task(NamedTuple):
    """A function (x, u, p) ↦ ẋ, and the further sections of the YAML that trains on it."""

    function: Function
    affine: bool
    sections: dict[str, Any]


def cstr() -> Task:
    """Continuous stirred tank, cyclopentadiene to cyclopentenol: concentrations B and temperature held.

    Klatt and Engell (1998), and do-mpc's example CSTR, in hours, mol/l, °C and kJ.
    """
    x, u, p = SX.sym("x", 4), SX.sym("u", 2), SX.sym("p", 2)
    (a, b, reactor, jacket), (flow, heat), (alpha, beta) = map(casadi.vertsplit, (x, u, p))
    kelvin = reactor + 273.15
    to_b, to_c = 1.287e12 * beta * exp(-9758.3 / kelvin), 1.287e12 * exp(-9758.3 / kelvin)
    to_d = 9.043e9 * exp(-8560.0 * alpha / kelvin)
    capacity = 0.9342 * 3.01
    reaction = to_b * a * 4.2 - to_c * b * 11.0 - to_d * a**2 * 41.85
    exchange = 4032.0 * 0.215 * (jacket - reactor)
    xdot = vertcat(
        flow * (5.1 - a) - to_b * a - to_d * a**2,
        -flow * b + to_b * a - to_c * b,
        -reaction / capacity + flow * (130.0 - reactor) + exchange / (capacity * 10.01),
        (heat - exchange) / (5.0 * 2.0),
    )
    return Task(Function("cstr", [x, u, p], [xdot], ["x", "u", "p"], ["xdot"]), True, {
        "system": {
            "states": {"A": "mol/l", "B": "mol/l", "reactor": "°C", "jacket": "°C"},
            "controls": {"flow": "1/h", "heat": "kJ/h"},
            "parameters": {"p_0": 1.0, "p_1": 1.0},
        },
        "target": {"B": 0.9, "reactor": 134.14},
        "cost": {"Q": [0, 100, 0.04, 0], "R": [5e-4, 5e-8], "Q_T": [0, 5, 0.002, 0]},
        "controls": {"lower": [5, -8500], "upper": [100, 0]},
        "initial_states": {"lower": [0.9, 0.7, 128, 123], "upper": [1.6, 1.1, 140, 135]},
        "horizon": {"steps": 100, "dt": 0.0025},
    })  # fmt: skip


def batch_bioreactor() -> Task:
    """Fed-batch bioreactor with inhibited growth: substrate held while biomass grows, product at the end.

    do-mpc's example batch reactor, in hours, g/l and l; the feed is counted from 0, since no state is held.
    """
    names = ("biomass", "substrate", "product", "volume")
    biomass, substrate, product, volume = (SX.sym(name) for name in names)
    feed, of_growth, fed = SX.sym("feed"), SX.sym("Y_x"), SX.sym("S_in")
    growth = 0.02 * substrate / (0.05 + substrate + substrate**2 / 5.0) * biomass
    produced, dilution = 0.004 * biomass, feed / volume
    xdot = vertcat(
        growth - dilution * biomass,
        -growth / of_growth - produced / 1.2 + dilution * (fed - substrate),
        produced - dilution * product,
        feed,
    )
    x = vertcat(biomass, substrate, product, volume)
    return Task(Function("bioreactor", [x, feed, vertcat(of_growth, fed)], [xdot]), True, {
        "system": {
            "states": dict(zip(names, ("g/l", "g/l", "g/l", "l"), strict=True)), "controls": {"feed": "l/h"},
            "parameters": {"Y_x": 0.4, "S_in": 200.0},
        },
        "target": [1.0, 0.5, 0.4, 120.0],
        "target_control": [0],
        "cost": {"Q": [0, 1, 0, 0], "R": 0.1, "Q_T": [0, 1, 100, 0]},
        "controls": {"lower": 0, "upper": 0.2},
        "initial_states": {"lower": [0.8, 0.3, 0, 110], "upper": [1.2, 0.7, 0.05, 130]},
        "horizon": {"steps": 100, "dt": 0.5},
    })  # fmt: skip


def rotating_masses() -> Task:
    """Three disks on springs between two motors that follow set angles with a lag; linear.

    do-mpc's page Getting started.
    """
    x, u = MX.sym("x", 8), MX.sym("u", 2)
    angle, rate, motor = x[:3], x[3:6], x[6:]
    stiffness, damping = casadi.DM([2.697, 2.66, 3.05, 2.86]) * 1e-3, casadi.DM([6.78, 8.01, 8.82]) * 1e-5
    ends = vertcat(motor[0], angle, motor[1])
    torque = stiffness * (ends[1:] - ends[:-1])
    xdot = vertcat(rate, (torque[1:] - torque[:-1] - damping * rate) / 2.25e-4, (u - motor) / 0.01)
    return Task(Function("masses", [x, u], [xdot], ["x", "u"], ["rhs"]), True, {
        "cost": {
            "Q": [1, 1, 1, 0.05, 0.05, 0.05, 0, 0], "R": [0.1, 0.1], "Q_T": [5, 5, 5, 0.5, 0.5, 0.5, 0, 0],
        },
        "controls": {"lower": -6.2832, "upper": 6.2832},
        "initial_states": {"lower": [-1, -1, -1, -2, -2, -2, -1, -1], "upper": [1, 1, 1, 2, 2, 2, 1, 1]},
        "horizon": {"steps": 200, "dt": 0.01},
    })  # fmt: skip


def double_pendulum() -> Task:
    """Two pendulums, one on the other, on a cart, balanced upright; accelerations by a linear solve of MX.

    do-mpc's example DIP, whose accelerations are algebraic states there.
    """
    x, force = MX.sym("x", 6), MX.sym("force")
    first, second, speed, rates = x[1], x[2], x[3:], x[4:]
    cart, mass, length, gravity = 0.6, 0.2, 0.5, 9.80665
    half, inertia = length / 2, mass * (length / 2) ** 2 / 3
    moment, tip = mass * half + mass * length, mass * half
    between = tip * length
    M = casadi.blockcat([
        [cart + 2 * mass, moment * cos(first), tip * cos(second)],
        [moment * cos(first), mass * half**2 + mass * length**2 + inertia, between * cos(first - second)],
        [tip * cos(second), between * cos(first - second), mass * half**2 + inertia],
    ])  # fmt: skip
    forces = vertcat(
        moment * rates[0] ** 2 * sin(first) + tip * rates[1] ** 2 * sin(second) + force,
        moment * gravity * sin(first) - between * rates[1] ** 2 * sin(first - second),
        tip * gravity * sin(second) + between * rates[0] ** 2 * sin(first - second),
    )
    xdot = vertcat(speed, casadi.inv(M) @ forces)
    return Task(Function("double_pendulum", [x, force], [xdot]), True, {
        "system": {
            "states": {
                "position": "m", "first": "rad", "second": "rad", "velocity": "m/s", "first_rate": "rad/s",
                "second_rate": "rad/s",
            },
            "controls": {"force": "N"},
            "angles": ["first", "second"],
        },
        "cost": {"Q": [1, 10, 10, 0.1, 0.1, 0.1], "R": 0.1, "Q_T": [10, 100, 100, 1, 1, 1]},
        "controls": {"lower": -4, "upper": 4},
        "initial_states": {"lower": [-0.3, -0.1, -0.1, 0, 0, 0], "upper": [0.3, 0.1, 0.1, 0, 0, 0]},
        "horizon": {"steps": 150, "dt": 0.02},
    })  # fmt: skip


def kite() -> Task:
    """A towing kite on its tether, steered to its place at the zenith; steering costs lift, −0.028 u².

    Erhard and Strauch (2013), and do-mpc's example kite.
    """
    theta, phi, psi = (SX.sym(name) for name in ("theta", "phi", "psi"))
    steering, glide, wind = SX.sym("u"), SX.sym("E_0"), SX.sym("v_0")
    lift = glide - 0.028 * steering**2
    turn = wind * lift * cos(theta) / 400.0
    azimuth = -turn / sin(theta) * sin(psi)
    xdot = vertcat(turn * (cos(psi) - tan(theta) / lift), azimuth, turn * steering + azimuth * cos(theta))
    return Task(Function("kite", [vertcat(theta, phi, psi), steering, vertcat(glide, wind)], [xdot]), False, {
        "system": {
            "states": {"theta": "rad", "phi": "rad", "psi": "rad"}, "controls": {"steering": "1"},
            "parameters": {"E_0": 6.0, "v_0": 10.0},
        },
        "target": {"phi": 0, "psi": 0},
        "cost": {"Q": [1, 1, 0.1], "R": 0.01, "Q_T": [10, 10, 1]},
        "controls": {"lower": -10, "upper": 10},
        "initial_states": {"lower": [0.5, -0.4, -0.5], "upper": [0.9, 0.4, 0.5]},
        "horizon": {"steps": 150, "dt": 0.2},
    })  # fmt: skip


def race_car() -> Task:
    """A car of scale 1:43 beside the middle of a bend at 1 m/s; rates of throttle and steering are its controls.

    Kloeser et al. (2020), and acados' example race_cars, where the curvature is a spline along the track.
    """
    model = _acados_model(["n", "alpha", "v", "D", "delta"], ["derD", "derDelta"], ["kappa"])
    (n, alpha, v, D, delta), kappa = casadi.vertsplit(model.x), model.p
    force = (0.28 - 0.05 * v) * D - 0.006 * v**2 - 0.011 * tanh(5 * v)
    along = v * cos(alpha + 0.5 * delta) / (1 - kappa * n)
    f_expl_expr = vertcat(
        v * sin(alpha + 0.5 * delta), v * 15.5 * delta - kappa * along, force / 0.043 * cos(0.5 * delta), model.u
    )
    return Task(Function("f", [model.x, model.u, model.p], [f_expl_expr]), True, {
        "system": {
            "states": {"offset": "m", "heading": "rad", "speed": "m/s", "throttle": "1", "steer": "rad"},
            "controls": {"throttle_rate": "1/s", "steer_rate": "rad/s"}, "parameters": {"kappa": 1.0},
        },
        "target": {"offset": 0, "speed": 1},
        "cost": {"Q": [100, 10, 4, 0.1, 1], "R": [0.01, 0.1], "Q_T": [20, 2, 1, 0.1, 0.1]},
        "controls": {"lower": [-10, -2], "upper": [10, 2]},
        "initial_states": {"lower": [-0.1, -0.3, 0.6, 0, -0.2], "upper": [0.1, 0.3, 1.4, 0.3, 0.2]},
        "horizon": {"steps": 100, "dt": 0.02},
    })  # fmt: skip


def dc_motor() -> Task:
    """A series-wound DC motor that drives a fan at a speed; its torque is quadratic in the current.

    Leonhard, Control of Electrical Drives (2001), section 6.
    """
    x, voltage, p = MX.sym("x", 2), MX.sym("voltage"), MX.sym("p", 2)
    current, speed, resistance, inductance = x[0], x[1], p[0], p[1]
    xdot = vertcat(
        (voltage - resistance * current - 0.05 * current * speed) / inductance,
        (0.05 * current**2 - 0.01 * speed - 5e-4 * speed**2) / 0.02,
    )
    return Task(Function("dc_motor", [x, voltage, p], [xdot], ["x", "u", "p"], ["xdot"]), True, {
        "system": {
            "states": {"current": "A", "speed": "rad/s"}, "controls": {"voltage": "V"},
            "parameters": {"p_0": 1.0, "p_1": 0.2},
        },
        "target": {"speed": 100},
        "cost": {"Q": [0, 0.01], "R": 2.5e-4, "Q_T": [0.001, 0.002]},
        "controls": {"lower": 0, "upper": 120},
        "initial_states": {"lower": [5, 60], "upper": [18, 140]},
        "horizon": {"steps": 150, "dt": 0.005},
    })  # fmt: skip


def van_der_pol() -> Task:
    """Van der Pol's oscillator brought to rest within 10 s.

    CasADi's example vdp.
    """
    first, second, u = SX.sym("x1"), SX.sym("x2"), SX.sym("u")
    xdot = vertcat((1 - second**2) * first - second + u, first)
    return Task(Function("vdp", [vertcat(first, second), u], [xdot], ["x", "u"], ["ode"]), True, {
        "cost": {"Q": [1, 1], "R": 1, "Q_T": [1, 1]},
        "controls": {"lower": -1, "upper": 1},
        "initial_states": {"lower": [-1, -1], "upper": [1, 1]},
        "horizon": {"steps": 200, "dt": 0.05},
    })  # fmt: skip


def rocket() -> Task:
    """A rocket that flies 10 m in 10 s and stops; its fuel burns with the square of the thrust.

    CasADi's example rocket.
    """
    x, thrust = MX.sym("x", 3), MX.sym("thrust")
    xdot = vertcat(x[1], (thrust - 0.05 * x[1] ** 2) / x[2], -0.1 * thrust**2)
    return Task(Function("rocket", [x, thrust], [xdot]), False, {
        "system": {"states": {"position": "m", "velocity": "m/s", "mass": "kg"}, "controls": {"thrust": "N"}},
        "target": [10, 0, 1],
        "target_control": [0],
        "cost": {"Q": 0, "R": 1, "Q_T": [100, 100, 0]},
        "controls": {"lower": -1, "upper": 1},
        "initial_states": {"lower": [-1, -0.5, 0.9], "upper": [1, 0.5, 1.1]},
        "horizon": {"steps": 100, "dt": 0.1},
    })  # fmt: skip


def chain() -> Task:
    """A mass on two springs between a wall and an end that is moved; without damping.

    Wirsching, Bock and Diehl (2006), and acados' example chain_mass.
    """
    names = [f"{name}_{axis}" for name in ("mass", "end", "rate") for axis in "xyz"]
    model = _acados_model(names, ["u_x", "u_y", "u_z"], [])
    mass, end, rate = casadi.vertsplit(model.x, 3)

    def pull(d: Any) -> Any:
        return 1.0 * (1 - 0.033 / sqrt(d.T @ d)) * d

    acceleration = (pull(end - mass) - pull(mass)) / 0.033 + casadi.DM([0, 0, -9.81])
    return Task(Function("chain", [model.x, model.u], [vertcat(rate, model.u, acceleration)]), True, {
        "system": {
            "states": {name: "m/s" if "rate" in name else "m" for name in names},
            "controls": dict.fromkeys(("end_rate_x", "end_rate_y", "end_rate_z"), "m/s"),
        },
        "target": {"end_x": 1, "end_y": 0, "end_z": 0},
        "cost": {"Q": [1] * 3 + [10] * 3 + [1] * 3, "R": [0.1] * 3, "Q_T": [5] * 3 + [20] * 3 + [2] * 3},
        "controls": {"lower": -1, "upper": 1},
        "initial_states": {
            "lower": [0.3, -0.2, -0.37, 0.8, -0.2, -0.2, -0.5, -0.5, -0.5],
            "upper": [0.7, 0.2, 0.03, 1.2, 0.2, 0.2, 0.5, 0.5, 0.5],
        },
        "horizon": {"steps": 100, "dt": 0.02},
    })  # fmt: skip


def quadruple_tank() -> Task:
    """Four tanks and two pumps: the levels of the lower two held; with pumps that never stop, as no tank may run dry.

    Johansson (2000), at his minimum-phase operating point, in cm, s and V.
    """
    h, u, p = SX.sym("h", 4), SX.sym("v", 2), SX.sym("gamma", 2)
    area, outlet = casadi.DM([28, 32, 28, 32]), casadi.DM([0.071, 0.057, 0.071, 0.057])
    flow = outlet * sqrt(2 * 981 * h)
    first, second = 3.33 * u[0], 3.35 * u[1]
    inflow = vertcat(flow[2] + p[0] * first, flow[3] + p[1] * second, (1 - p[1]) * second, (1 - p[0]) * first)
    return Task(Function("tanks", [h, u, p], [(inflow - flow) / area]), True, {
        "system": {
            "states": {f"level_{k}": "cm" for k in range(1, 5)}, "controls": {"pump_1": "V", "pump_2": "V"},
            "parameters": {"gamma_0": 0.7, "gamma_1": 0.6},
        },
        "target": {"level_1": 12.4, "level_2": 12.7},
        "cost": {"Q": [1, 1, 0, 0], "R": [1, 1], "Q_T": [20, 20, 0, 0]},
        "controls": {"lower": 1, "upper": 10},
        "initial_states": {"lower": [9, 9.5, 0.8, 0.5], "upper": [16, 16, 3, 2.5]},
        "horizon": {"steps": 100, "dt": 2},
    })  # fmt: skip


def f8_aircraft() -> Task:
    """Longitudinal motion of an F-8 aircraft, cubic in the tail's deflection.

    Garrard and Jordan (1977).
    """
    x, u = MX.sym("x", 3), MX.sym("u")
    attack, pitch_rate = x[0], x[2]
    xdot = vertcat(
        -0.877 * attack + pitch_rate - 0.088 * attack * pitch_rate + 0.47 * attack**2 - 0.019 * x[1] ** 2
        - attack**2 * pitch_rate + 3.846 * attack**3
        - 0.215 * u + 0.28 * attack**2 * u + 0.47 * attack * u**2 + 0.63 * u**3,
        pitch_rate,
        -4.208 * attack - 0.396 * pitch_rate - 0.47 * attack**2 - 3.564 * attack**3
        - 20.967 * u + 6.265 * attack**2 * u + 46 * attack * u**2 + 61.4 * u**3,
    )  # fmt: skip
    return Task(Function("f8", [x, u], [xdot]), False, {
        "system": {
            "states": {"attack": "rad", "pitch": "rad", "pitch_rate": "rad/s"}, "controls": {"tail": "rad"},
        },
        "cost": {"Q": [0.25, 0.25, 0.25], "R": 1, "Q_T": [1, 1, 1]},
        "controls": {"lower": -0.2, "upper": 0.2},
        "initial_states": {"lower": [-0.3, -0.3, -0.3], "upper": [0.3, 0.3, 0.3]},
        "horizon": {"steps": 160, "dt": 0.05},
    })  # fmt: skip


class _AcadosModel(NamedTuple):
    """The fields of acados' AcadosModel that are read here."""

    x: Any
    u: Any
    p: Any


def _acados_model(states: list[str], controls: list[str], parameters: list[str]) -> _AcadosModel:
    return _AcadosModel(*(vertcat(*map(SX.sym, names)) for names in (states, controls, parameters)))


MODELS: dict[str, Callable[[], Task]] = {
    make.__name__: make
    for make in (
        cstr, batch_bioreactor, rotating_masses, double_pendulum, kite, race_car, dc_motor, van_der_pol, rocket,
        chain, quadruple_tank, f8_aircraft,
    )
}  # fmt: skip
