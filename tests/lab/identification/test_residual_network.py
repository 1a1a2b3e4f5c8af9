"""r(x) beside a model of equations: found where it is needed, left out where it is not, and bounded."""

import csv
import json

import numpy as np
import pytest
import torch
import yaml

from lyapnet.base.errors import UsageError
from lyapnet.cli import main
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import config_from_plain, load_config
from lyapnet.lab.identification import Measurements, identify
from lyapnet.lab.identification.residual_network import Network, identify_residual
from lyapnet.lab.identification.shooting import rk4
from lyapnet.task.systems.equations import defined

STATES, CONTROLS = {"position": "m", "speed": "m/s"}, {"force": "N"}
MODEL = """
der(position) = speed
der(speed) = (force - damping*speed - 2*position)/mass  # linear friction
"""
TASK = {
    "experiment": "cart",
    "system": {
        "name": "equations", "equations": MODEL, "states": STATES, "controls": CONTROLS,
        "parameters": {"mass": 1.2, "damping": 0.5},
    },
    "cost": {"Q": [1, 1], "R": 1, "Q_T": [1, 1]},
    "initial_states": {"lower": [-1, -1], "upper": [1, 1]}, "horizon": {"steps": 20, "dt": 0.05},
}  # fmt: skip
NOISE, STEP = 0.005, 0.05


def recording(cubic, seconds):
    """A cart on a spring, with friction 0.4 v + cubic v³, read with noise under random forces."""
    text = f"der(position) = speed\nder(speed) = force - 0.4*speed - {cubic}*speed**3 - 2*position"
    system, random = defined(text, STATES, CONTROLS)(), np.random.default_rng(0)
    count = round(seconds / STEP)
    u = np.repeat(random.uniform(-3, 3, count // 10 + 1), 10)[:count, None]
    x, path = torch.zeros(1, 2, dtype=torch.float64), []
    for k in range(count):
        path.append(x[0].numpy())
        for _ in range(5):
            x = rk4(system, x, torch.from_numpy(u[k : k + 1]), torch.tensor([[STEP / 5]]).double())
    y = np.array(path)[:, :1] + NOISE * random.normal(size=(count, 1))
    return Measurements("data", STEP * np.arange(count), u, y, ("position",))


def found(cubic, seconds, **options):
    config, data = config_from_plain(TASK), [recording(cubic, seconds)]
    parameters = identify(config, data)
    return parameters, identify_residual(config, data, parameters, **options)


def network(units=12, outputs=1):
    random = np.random.default_rng(3)
    return Network(
        ("position", "speed"), tuple(range(1, 1 + outputs)), np.array([0.2, -0.1]), np.array([0.5, 2.0]),
        random.normal(size=(units, 2)), random.normal(size=units), random.uniform(1, 2, outputs),
        random.normal(size=(outputs, units)),
    )  # fmt: skip


def test_bounds_hold_on_the_box_and_are_not_far():
    r, random = network(), np.random.default_rng(0)
    x = r.center + r.width * random.uniform(-1, 1, (20_000, 2))
    largest, slopes = r.bounds()
    assert np.abs(r(x)).max() <= largest[0] <= 1.1 * np.abs(r(x)).max()
    for j in range(2):
        step = 1e-6 * np.eye(2)[j]
        steepest = np.abs((r(x + step) - r(x - step)) / 2e-6).max()
        assert steepest <= slopes[0, j] * (1 + 1e-6)
        assert slopes[0, j] <= 1.2 * steepest
    assert np.abs(r(100 * x)).max() <= r.everywhere[0]


def test_equations_with_it_are_the_sum_and_stay_affine():
    r, x = network(), torch.randn(9, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    parameters = {"mass": 1.2, "damping": 0.5}
    without, with_it = (
        defined(text, STATES, CONTROLS, [*parameters])(**parameters) for text in (MODEL, r.added_to(MODEL))
    )
    assert with_it.affine
    torch.testing.assert_close(with_it.g(x), without.g(x))
    difference = (with_it.f(x) - without.f(x)).numpy()
    np.testing.assert_allclose(difference[:, 1], r(x.numpy())[:, 0], rtol=1e-6)
    assert not difference[:, 0].any()
    again = defined(r.added_to(r.added_to(MODEL)), STATES, CONTROLS, [*parameters])(**parameters)
    np.testing.assert_allclose((again.f(x) - without.f(x)).numpy(), 2 * difference, rtol=1e-9, atol=1e-12)


@pytest.mark.gate
def test_cubic_friction_is_found():
    parameters, residual = found(0.5, 40.0)
    assert residual.needed
    assert residual.ratio < 0.5
    assert residual.after["position"] < 0.5 * residual.before["position"]
    r = residual.network
    assert [r.states[i] for i in r.rates] == ["speed"], "the rate of position is speed itself"
    box = [r.center - r.width, r.center + r.width]
    speed = np.linspace(*(0.8 * end[1] for end in box), 21)
    estimated, mass = parameters.values["damping"], parameters.values["mass"]
    lacking = -(0.4 * speed + 0.5 * speed**3) + estimated / mass * speed
    got = r(np.stack([np.full(21, r.center[0]), speed], -1))[:, 0]
    assert np.sqrt(np.mean((got - lacking) ** 2)) < 0.35 * np.sqrt(np.mean(lacking**2))


@pytest.mark.gate
def test_a_right_model_needs_none():
    _, residual = found(0.0, 20.0, units=6)
    assert not residual.needed
    assert residual.ratio == pytest.approx(1, abs=0.05)


@pytest.mark.gate
def test_without_data_that_are_held_out_nothing_is_claimed():
    config, data = config_from_plain(TASK), [recording(0.5, 10.0)]
    residual = identify_residual(config, data, identify(config, data, held_out=0.0), held_out=0.0, units=2)
    assert np.isnan(residual.ratio)
    assert not residual.needed


def test_a_system_without_equations_is_refused():
    config, data = config_from_plain(TASK), [recording(0.0, 10.0)]
    parameters = identify(config, data)
    task = {**TASK, "system": {"name": "pendulum"}}
    with pytest.raises(UsageError, match=r"Expected a system of equations for --residual, got Pendulum; .+\."):
        identify_residual(config_from_plain(task), data, parameters)


@pytest.mark.gate
@pytest.mark.parametrize("cubic", [0.5, 0.0])
def test_the_command(cubic, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cart.yaml").write_text(yaml.safe_dump(TASK), encoding="utf-8")
    data = recording(cubic, 30.0)
    with (tmp_path / "data.csv").open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["t", "force", "position"])
        rows.writerows(np.column_stack([data.t, data.u, data.y]).tolist())
    assert main(["identify", "cart.yaml", "data.csv", "--residual", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["residual"]
    assert told["needed"] == bool(cubic)
    text = (tmp_path / "cart_identified.yaml").read_text(encoding="utf-8")
    assert ("residual0 = tanh(" in text) == ("r of speed: at most" in text) == bool(cubic)
    system = build_problem(load_config("cart_identified.yaml")).system
    assert system.affine
    if cubic:
        x = torch.tensor([[0.0, told["box"]["speed"][1]]], dtype=torch.float64)
        plain = build_problem(config_from_plain(TASK)).system
        values = load_config("cart_identified.yaml").system.parameters
        plain.mass, plain.damping = values["mass"], values["damping"]
        added = float((system.f(x) - plain.f(x))[0, 1])
        assert 0 < abs(added) <= told["largest"]["speed"]
