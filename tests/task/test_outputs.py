"""What is measured of a state: readings of states and of h(x), with their noise; and what is refused."""

import re

import pytest
import torch
from torch.testing import assert_close

from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly import Parts, build_problem
from lyapnet.experiment.config import config_from_plain, to_plain
from lyapnet.task.outputs import MeasuredStates, SystemOutput
from lyapnet.task.systems import Cartpole, Pendulum

TASK = {
    "experiment": "outputs",
    "system": {"name": "pendulum"},
    "cost": {"Q": [1, 0.1], "R": 0.1, "Q_T": [2, 1]},
    "initial_states": {"lower": -1, "upper": 1},
    "horizon": {"steps": 5, "dt": 0.05},
}
WRONG = {
    "one number": lambda x: x.sum(),
    "too many entries": lambda x: torch.cat([x, x], -1),
    "no axis of readings": lambda x: x[..., 0],
    "None": lambda x: None,
    "of all states": lambda x: (x - x.mean(0))[..., :1],
}


class Seen(Pendulum):
    """A pendulum with the height of its tip measured."""

    output_names, output_units = ("height",), ("m",)

    def output(self, x):
        return torch.cos(x[..., :1])


def built(outputs, system=None):
    return build_problem(config_from_plain({**TASK, "outputs": outputs}), Parts(system=system))


def test_measured_states_have_their_names_units_and_angles():
    outputs = MeasuredStates(Cartpole(), [3, 1], [0.1, 0.2])
    x = torch.randn(2, 5, 4)
    assert_close(outputs(x), x[..., [3, 1]])
    assert (outputs.names, outputs.units, outputs.angles) == (
        ["pole velocity", "pole angle"], ["rad/s", "rad"], [1],
    )  # fmt: skip
    drawn = outputs.draw(torch.zeros(100_000, 4), torch.Generator().manual_seed(0))
    assert_close(drawn.std(0), outputs.noise, rtol=0.02, atol=0)
    assert abs(float(torch.corrcoef(drawn.mT)[0, 1])) < 0.02


def test_the_output_of_a_system_is_named_by_it():
    outputs = SystemOutput(Seen(), [0.1], torch.rand(4, 2))
    assert ([*outputs.names], [*outputs.units], [*outputs.angles]) == (["height"], ["m"], [])
    assert_close(outputs(torch.tensor([0.5, 1.0])), torch.tensor([0.5]).cos())


@pytest.mark.parametrize("noise", [[], [0.1, 0.0], [-0.1], [float("inf")], [float("nan")]])
def test_noise_is_positive(noise):
    with pytest.raises(ValueError, match="Expected a standard deviation > 0 for each reading"):
        MeasuredStates(Cartpole(), [0] * len(noise), noise)


@pytest.mark.parametrize("wrong", WRONG)
def test_an_output_of_wrong_shape_is_refused_before_training(wrong):
    class Wrong(Pendulum):
        def output(self, x):
            return WRONG[wrong](x)

    with pytest.raises(UsageError, match=re.escape("Wrong.output(x)")):
        built({"noise": 0.1}, Wrong())
    built({"noise": 0.1}, Seen())
    built({"measure": ["angle"], "noise": 0.1}, Wrong())  # which does not read it


@pytest.mark.parametrize(
    ("outputs", "message"),
    [
        ({"measure": ["angle"]}, "Expected outputs.noise, the standard deviation of each reading, got none"),
        ({"noise": 0.1}, "Expected outputs.measure, or a method output(x) of Pendulum, got neither"),
        ({"measure": ["speed"], "noise": 0.1}, "Expected outputs.measure among angle, velocity, got 'speed'"),
        ({"measure": ["angle"], "noise": [0.1, 0.1]}, "Expected outputs.noise with one entry (angle), got 2"),
        ({"measure": ["angle"], "noise": 0.1, "process_noise": {"speed": 1}},
         "Expected outputs.process_noise among angle, velocity, got 'speed'; name states, or parameters of a family"),
        ({"measure": ["angle"], "noise": 0.1, "initial_deviation": [1, 1, 1]},
         "Expected outputs.initial_deviation with 2 entries (angle, velocity), got 3"),
        ({"measured": ["angle"]}, "unknown key outputs.measured; did you mean outputs.measure?"),
    ],
)  # fmt: skip
def test_a_section_that_does_not_fit_is_refused(outputs, message):
    with pytest.raises(UsageError, match=re.escape(message)):
        built(outputs)


def test_a_checkpoint_knows_what_is_measured():
    """The section is part of the config that it holds; one of an earlier version has none."""
    section = {"measure": ["angle"], "noise": 0.1, "process_noise": {"velocity": 0.2}}
    config = config_from_plain({**TASK, "outputs": section})
    assert config_from_plain(to_plain(config)) == config
    assert config.outputs.noise == [0.1]
    plain = to_plain(config_from_plain(TASK))
    del plain["outputs"]
    assert config_from_plain(plain).outputs.noise is None
