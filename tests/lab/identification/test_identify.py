"""Parameters from data: right without noise, in their regions with it; what is not told is named, and a wrong model."""

import numpy as np
import pytest
import torch

from lyapnet import ControlAffineSystem
from lyapnet.base.errors import LyapnetError, UsageError
from lyapnet.experiment.config import config_from_plain
from lyapnet.lab.identification import Measurements, identify
from lyapnet.lab.identification.report import as_json, sentences, verdict
from lyapnet.lab.identification.unknown_system import UnknownSystem
from lyapnet.task.systems import SYSTEMS, Pendulum
from tests.lab.identification.coverage import repeated
from tests.lab.identification.plants import PLANTS, record, simulate
from tests.task.test_family import READS


def found_of(name, seconds, config=None, parameters=(), held_out=0.0, settings=None, **options):
    """What is identified of a plant from a short recording."""
    plant = PLANTS[name]
    plant = plant if config is None else plant._replace(config=config)
    return identify(
        plant.settings(**(settings or {})), record(plant, seconds=seconds, **options), parameters, held_out=held_out
    )


@pytest.mark.parametrize("name", ["tanks", pytest.param("pendulum", marks=pytest.mark.gate), "cartpole"])
def test_without_noise_parameters_are_found_to_a_millionth(name):
    found = found_of(name, {"tanks": 20.0, "pendulum": 4.0, "cartpole": 1.6}[name], size=0.0)
    for parameter, value in PLANTS[name].true.items():
        assert found.values[parameter] == pytest.approx(value, rel=1e-6)
    assert not found.unknown_directions


@pytest.mark.gate
def test_true_parameters_are_in_the_region(monkeypatch):
    """A sample of the table in docs/identify.md: with 95 % each, at least 4 of 6 with a probability of 99.8 %."""
    monkeypatch.setitem(PLANTS, "tanks", PLANTS["tanks"]._replace(seconds=20.0))
    found, true = repeated("tanks", 6), PLANTS["tanks"].true
    assert sum(each.contains(true) for each in found) >= 4
    far = {name: value * 1.2 for name, value in true.items()}
    assert not any(each.contains(far) for each in found), "the twin: regions are small"
    spread = np.std([[*each.values.values()] for each in found], axis=0, ddof=1)
    said = np.mean([np.sqrt(np.diag(each.covariance)) for each in found], 0)
    assert ((spread / said > 0.27) & (spread / said < 1.83)).all(), "χ² of 5 degrees of freedom, at 99.5 %"


def test_the_noise_is_found():
    found = found_of("tanks", 40.0)
    assert found.noise == pytest.approx({"upper level": 0.004, "lower level": 0.004}, rel=0.15)
    assert found.model_is_right


@pytest.mark.gate
def test_intervals_count_with_coloured_noise():
    """Of one recording: the spread of estimates under noise that is as large and white is less than half as wide."""
    white, coloured = (found_of("tanks", 40.0, colour=colour) for colour in (0.0, 0.95))
    assert white.model_is_right
    assert not coloured.model_is_right
    ratio = np.sqrt(np.diag(coloured.covariance) / np.diag(white.covariance))
    assert (ratio > 2).all()


# What the data do not tell


def test_parameters_that_only_count_together_are_named():
    found = found_of("pendulum", 4.0, parameters=["mass", "length", "damping", "gravity"])
    (direction,) = found.unknown_directions
    unit = direction["length"]
    assert {name: change / unit for name, change in direction.items()} == pytest.approx(
        {"length": 1, "gravity": 1, "mass": -2}, rel=1e-3
    )
    assert [name for name, one in found.parameters.items() if one.told] == ["damping"]
    assert found.parameters["damping"].low < 0.1 < found.parameters["damping"].high
    (line,) = [line for line in sentences(found) if "not told" in line]
    assert "mass" in line
    assert "2.00%" in line
    ratio = found.values["gravity"] / found.values["length"]
    assert ratio == pytest.approx(9.81 / 0.5, rel=0.02), "what is told of them is right"
    near = {name: value * (1 + 1e-4 * direction.get(name, 0.0)) for name, value in found.values.items()}
    assert found.contains(near)
    assert not found.contains({**found.values, "gravity": 1.02 * found.values["gravity"]})


@pytest.fixture
def swinging():
    """A pendulum without damping that swings by itself."""
    t, x0 = np.arange(0, 4, 0.02), [np.pi - 1, 0.0]
    angle = simulate(Pendulum(1.0, 0.5).double(), x0, t, np.zeros((len(t), 1)))[:, :1]
    noise = 0.01 * np.random.default_rng(0).standard_normal(angle.shape)
    return Measurements("a", t, np.zeros(angle.shape), angle + noise, ("angle",))


@pytest.mark.gate
def test_a_parameter_that_has_no_effect_on_the_data_is_named(swinging):
    """Mass does not count without a torque."""
    settings = PLANTS["pendulum"]._replace(config={"mass": 1.3, "length": 0.6}).settings()
    found = identify(settings, [swinging])
    assert found.unknown_directions == [{"mass": 1.0}]
    assert found.values["mass"] == pytest.approx(1.3, abs=1e-3), "it stays where it was"
    assert not found.parameters["mass"].told
    assert found.values["length"] == pytest.approx(0.5, rel=0.01)
    assert "not told: mass has no effect on these data; leave it out of --parameters." in sentences(found)
    assert as_json(found, [])["parameters"]["mass"]["low"] is None
    both = identify(settings, [swinging], ["length", "mass", "gravity"]).unknown_directions
    assert both == [{"mass": 1.0}, pytest.approx({"length": 1.0, "gravity": 1.0}, rel=1e-3)]


@pytest.mark.gate
def test_a_parameter_that_the_data_hardly_tell_is_named():
    """Noise alone moves the readings of a pendulum at rest."""
    t = np.arange(0, 4, 0.02)
    y = np.pi + 0.01 * np.random.default_rng(0).standard_normal((len(t), 1))
    settings = PLANTS["pendulum"].settings()
    found = identify(settings, [Measurements("a", t, np.zeros((len(t), 1)), y, ("angle",))], ["mass"])
    assert any("hardly told: mass" in line for line in sentences(found))


# A wrong model, and its twin


@pytest.mark.gate
def test_a_wrong_model_is_told_by_its_residuals():
    right = found_of("pendulum", 6.0)
    wrong = found_of(
        "pendulum", 6.0, parameters=["mass", "length"], config={"mass": 1.3, "length": 0.6, "damping": 0.0}
    )
    assert right.model_is_right
    assert not wrong.model_is_right
    assert verdict(right.tests[0]).startswith("white")
    assert verdict(wrong.tests[0]).startswith("correlated over")
    assert any("does not explain angle" in line for line in sentences(wrong))
    assert not any("does not explain" in line for line in sentences(right))
    assert right.fit["angle"] > wrong.fit["angle"] + 0.02


@pytest.mark.parametrize(("said", "right"), [(0.01, True), (0.005, False), (0.02, False)])
def test_a_noise_that_is_said_is_held_against_the_residuals(said, right):
    found = found_of("pendulum", 4.0, settings={"outputs": {"measure": ["angle"], "noise": [said]}})
    assert found.noise == {"angle": said}
    assert found.model_is_right is right
    assert found.tests[0].ratio == pytest.approx(0.01 / said, rel=0.2)
    assert any("another one than outputs.noise" in line for line in sentences(found)) is not right


# Files, pieces, readings


@pytest.mark.gate
def test_what_is_held_out_is_not_fitted():
    plant = PLANTS["tanks"]
    one, other = record(plant, [0, 1], seconds=20.0)
    found = identify(plant.settings(), [one], test=[other])
    assert found.values == identify(plant.settings(), [one], held_out=0.0).values
    assert [curve.held_out for curve in found.curves] == [False, True]
    spoilt = Measurements("other", other.t, other.u, other.y[::-1].copy(), other.outputs)
    again = identify(plant.settings(), [one], test=[spoilt])
    assert again.values == found.values
    assert again.fit_held_out["lower level"] < found.fit_held_out["lower level"]


def test_several_files_tell_more_than_one():
    plant = PLANTS["tanks"]
    recordings = record(plant, [0, 1, 2], seconds=20.0)
    one, all_three = (identify(plant.settings(), some, held_out=0.0) for some in (recordings[:1], recordings))
    assert all_three.contains(plant.true)
    ratio = np.sqrt(np.diag(all_three.covariance) / np.diag(one.covariance))
    assert (ratio < 0.9).all()
    assert all_three.pieces == 3


@pytest.mark.gate
def test_a_plant_that_falls_is_followed_in_pieces():
    """Errors grow 20-fold in a second: no trajectory follows it for long, while pieces do, and tell what they can."""
    system = Pendulum(1.0, 0.5, 0.1).double()
    t, x, generator = np.arange(0, 8, 0.02), np.array([0.05, 0.0]), np.random.default_rng(0)
    states, controls = [], []
    for _ in t:  # held upright by a feedback that is excited, with gusts
        u = -12 * x[0] - 3 * x[1] + generator.normal(0, 1.0)
        states.append(x)
        controls.append(u)
        for _ in range(4):
            x = x + 0.005 * system.dynamics(torch.from_numpy(x), torch.tensor([u])).numpy()
        x = x + np.array([0, 0.02 * generator.normal()])
    y = np.array(states)[:, :1] + 0.002 * generator.standard_normal((len(t), 1))
    recording = Measurements("a", t, np.array(controls)[:, None], y, ("angle",))
    found = identify(PLANTS["pendulum"].settings(), [recording], held_out=0.0)
    assert found.pieces > 3
    assert any(f"{found.pieces} pieces" in line for line in sentences(found))
    assert found.values["length"] == pytest.approx(0.5, rel=0.2)


# What is refused


@pytest.mark.gate
def test_parameters_count_where_initial_states_are_fixed():
    """Friction of a cart-pole that begins at rest."""
    fixed = {"initial_states": {"lower": [0, 3.1, 0, 0], "upper": [0, 3.2, 0, 0]}}
    assert found_of("cartpole", 1.6, settings=fixed).parameters.keys() == PLANTS["cartpole"].true.keys()


class Derived(ControlAffineSystem):
    """A parameter that f reads through another attribute."""

    state_names, state_units = ("x",), ("m",)
    control_names, control_units = ("u",), ("N",)

    def __init__(self, rate: float = 1.0, gain: float = 1.0, unread: float = 1.0, lost: float = 1.0):
        super().__init__()
        self.rate, self.gain, self.unread, self.double_rate, self.lost = rate, gain, unread, 2 * rate, lost

    def f(self, x):
        return -self.double_rate * x - 0 * self.rate * x - torch.as_tensor(self.lost).detach() * x

    def g(self, x):
        return x.new_tensor([[self.gain]]).expand(*x.shape[:-1], 1, 1)


@pytest.mark.parametrize(
    ("parameters", "expected"),
    [
        (["rate"], r"Expected Derived to read rate as self\.rate, got another .*; derive in f and g"),
        (["gain"], r"operations that take gain as a tensor, got .*; write torch\.stack in the place of"),
        (["lost"], r"keep the derivative by self\.lost, got .*; write torch\.stack in the place of"),
        (["unread"], r"Expected Derived\.f, g or output to read unread, got the same"),
        (["gian"], r"Expected parameters of Derived \(rate, gain, unread, lost\), got 'gian'; did you mean gain\?"),
        (["gain", "gain"], "Expected each parameter once"),
    ],
)
def test_parameters_that_cannot_be_sought_are_refused(parameters, expected):
    config = config_from_plain(
        {"experiment": "x", "system": {"name": f"{__name__}:Derived"}, "horizon": {"steps": 1},
         "initial_states": {"lower": [-1], "upper": [1]}}
    )  # fmt: skip
    t = np.arange(40.0)
    with pytest.raises(UsageError, match=expected):
        identify(config, [Measurements("a", t, t[:, None], t[:, None], ("x",))], parameters)


@pytest.mark.parametrize("name", READS)
def test_parameters_of_registered_systems_can_be_sought(name):
    system = SYSTEMS[name]()
    box = {"lower": [-0.3] * system.n, "upper": [0.3] * system.n}
    config = config_from_plain(
        {"experiment": "x", "system": {"name": name}, "initial_states": box, "horizon": {"steps": 1}}
    )
    assert UnknownSystem(config, READS[name], system.state_names[:1]).names == READS[name]


def test_files_with_other_readings_are_refused():
    (one,) = record(PLANTS["tanks"], seconds=10.0)
    (other,) = record(PLANTS["tanks"], seconds=10.0, measured=["upper level"])
    with pytest.raises(UsageError, match="Expected the same readings in all files, got upper level, lower level in"):
        identify(PLANTS["tanks"].settings(), [one, other])


def test_data_that_no_trajectory_follows_are_refused():
    """A tank cannot be below its bottom."""
    (one,) = record(PLANTS["tanks"], seconds=10.0)
    with pytest.raises(LyapnetError, match=r"Expected data that the config's model can follow.*; start from better"):
        identify(PLANTS["tanks"].settings(), [Measurements("a", one.t, one.u, -one.y, one.outputs)])


def test_an_estimate_ends_where_the_system_does():
    """A damping of zero is estimated as no less."""
    found = found_of("pendulum", 4.0, system=Pendulum(1.0, 0.5, 0.0).double(), size=3.0)
    damping = found.parameters["damping"]
    assert damping.low == 0.0 <= damping.value
    assert damping.value < 0.01
