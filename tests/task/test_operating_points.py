"""Operating points: equilibria with some components given, against those known in closed form."""

import json
import logging
import math

import pytest
import torch
import yaml
from torch.testing import assert_close

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.cli import main
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.assembly.classes import Parts
from lyapnet.experiment.config import config_from_plain
from lyapnet.task.operating_points import OperatingPoints
from lyapnet.task.sets import Box, ControlBox, Unbounded
from lyapnet.task.systems import Cartpole, Pendulum
from tests.marks import sample

L, C, LOAD, SOURCE, LOSS = 360e-6, 66e-6, 50.0, 10.0, 0.2
CURRENT = (SOURCE - math.sqrt(SOURCE**2 - 4 * LOSS * 15**2 / LOAD)) / (2 * LOSS)  # (10 − ri) i = v²/R at 15 V
DUTY = 1 - 15 / LOAD / CURRENT


class Boost(lyapnet.ControlAffineSystem):
    """An averaged boost converter, 10 V to 15 V; u is the duty cycle."""

    state_names, state_units = ("current", "output voltage"), ("A", "V")
    control_names, control_units = ("duty",), ("1",)

    def __init__(self, scale: float = 1.0):
        super().__init__()
        self.scale = scale  # of the unit of the current

    def f(self, x):
        i, v = x[..., 0] / self.scale, x[..., 1]
        return torch.stack([self.scale * (SOURCE - LOSS * i - v) / L, (i - v / LOAD) / C], -1)

    def g(self, x):
        i, v = x[..., 0] / self.scale, x[..., 1]
        return torch.stack([self.scale * v / L, -i / C], -1)[..., None]


class Tank(lyapnet.ControlAffineSystem):
    """ẋ = x³ − x + u(x − 2): without control at −1, 0 and 1."""

    state_names, state_units = ("level",), ("m",)
    control_names, control_units = ("flow",), ("1/s",)

    def f(self, x):
        return x**3 - x

    def g(self, x):
        return (x - 2)[..., None]


class Level(lyapnet.ControlAffineSystem):
    """A fixed point z² = 4 that no control moves, beside an integrator."""

    state_names, state_units = ("z", "y"), ("", "")
    control_names, control_units = ("u",), ("",)

    def f(self, x):
        return torch.stack([4 - x[..., 0] ** 2, torch.zeros_like(x[..., 1])], -1)

    def g(self, x):
        return x.new_tensor([[0.0], [1.0]]).expand(*x.shape[:-1], 2, 1)


TASK = {
    "experiment": "boost", "system": {"name": f"{__name__}:Boost"}, "cost": {"Q": [1, 1], "R": 1, "Q_T": [1, 1]},
    "controls": {"lower": 0, "upper": 0.9}, "initial_states": {"lower": [0, 8], "upper": [1.5, 18]},
    "horizon": {"steps": 10, "dt": 1e-5},
}  # fmt: skip


def problem_of(**changes):
    parts = Parts(system=changes.pop("system", Boost()))
    return build_problem(config_from_plain({**TASK, **changes}), parts)


def search(system, low, high, controls=None):
    return OperatingPoints(system, controls or Unbounded(), Box(low, high))


@pytest.mark.parametrize("target", [{"output voltage": 15}, {"output_voltage": 15.0}, [0.4541, 15], [0.4542, 15.0]])
def test_a_voltage_asks_for_its_current_and_duty(target):
    problem = problem_of(target=target)
    assert_close(problem.goal, torch.tensor([CURRENT, 15.0]), rtol=1e-12, atol=0)
    assert_close(problem.rest, torch.tensor([DUTY]), rtol=1e-12, atol=0)
    assert float(problem.cost.running(problem.goal, problem.rest)) == 0


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_units_do_not_matter(scale):
    box = {"lower": [0, 8], "upper": [1.5 * scale, 18]}
    problem = problem_of(system=Boost(scale), target={"output voltage": 15}, initial_states=box)
    assert_close(problem.goal, torch.tensor([CURRENT * scale, 15.0]), rtol=1e-12, atol=0)


def test_what_misses_by_more_than_rounding_is_refused_with_the_nearest():
    with pytest.raises(UsageError, match=r"that some control holds.* rate of current at \[3\.0, 15\.0\]; .* such as"):
        problem_of(target=[3, 15])
    with pytest.raises(UsageError, match="such as"):
        problem_of(target={"output voltage": 15, "current": 0.6})


@pytest.mark.gate
def test_of_several_it_is_the_nearest_to_the_centre_and_others_are_listed(caplog):
    found = search(Tank(), [0.7], [1.9]).find({})
    assert len(found) == 1, "with its control free every level is one: a curve"
    (near, far) = search(Level(), [0.5, -1.0], [1.5, 1.0]).find({1: 0.3})
    assert_close(near.x, torch.tensor([2.0, 0.3]), rtol=1e-12, atol=0)
    assert_close(far.x, torch.tensor([-2.0, 0.3]), rtol=1e-12, atol=0)
    (first, *_) = search(Level(), [-1.5, -1.0], [-0.5, 1.0]).find({1: 0.3})
    assert float(first.x[0]) == pytest.approx(-2)
    with caplog.at_level(logging.WARNING):
        problem_of(system=Level(), target={"y": 0.3}, controls={"lower": -1, "upper": 1},
                   initial_states={"lower": [0.5, -1], "upper": [1.5, 1]})  # fmt: skip
    (note,) = [record.getMessage() for record in caplog.records]
    assert "solved for z = 2, held by u = 0" in note
    assert "the nearest to X₀'s centre of 2; also z = -2" in note


class Heavy(Level):
    """Each of the two points needs its own, large control: u = 1e5 z holds y."""

    def f(self, x):
        return torch.stack([3 - x[..., 0] ** 2, -1e5 * x[..., 0]], -1)


def test_a_point_that_is_found_again_is_the_same_in_units_of_its_controls_too():
    found = search(Heavy(), [0.5, -1.0], [1.5, 1.0], ControlBox(-1e6, 1e6)).find({1: 0.3})
    root = math.sqrt(3)
    assert_close(torch.stack([point.x[0] for point in found]), torch.tensor([root, -root]), rtol=1e-9, atol=0)
    assert_close(torch.stack([point.u[0] for point in found]), 1e5 * torch.tensor([root, -root]), rtol=1e-9, atol=0)


@pytest.mark.gate
def test_limits_of_states_and_controls_choose():
    inside = {"lower": [-1.5, -1], "upper": [0.9, 1]}
    both = problem_of(system=Level(), target={"y": 0.1}, initial_states=inside)
    assert float(both.goal[0]) == -2
    limited = {"lower": {"z": -1.6}}
    assert float(problem_of(system=Level(), target={"y": 0.1}, initial_states=inside, constraints=limited).goal[0]) == 2
    with pytest.raises(UsageError, match=r"at the target within its limits, got duty \(1\) = 0\.339"):
        problem_of(target={"output voltage": 15}, controls={"lower": 0, "upper": 0.2})


def test_distances_are_in_units_of_x0_and_angles_are_modulo_a_turn():
    """Extents: the widths 4 and 2, the centre 3 of a state that X₀ fixes, and 1 of one that it fixes at zero."""
    points = search(Cartpole(), [-1.0, -1.0, 3.0, 0.0], [3.0, 1.0, 3.0, 0.0])
    assert points.distance(torch.tensor([1.0, 0.0, 3.0, 0.0])) == 0
    parts = [(3.0, 0.0, 3.0, 0.0), (1.0, -4 * math.pi + 0.5, 3.0, 0.0), (1.0, 0.0, -3.0, 0.0), (1.0, 0.0, 3.0, 0.25)]
    assert [points.distance(torch.tensor(x)) for x in parts] == pytest.approx([0.5, 0.25, 2.0, 0.25])
    assert points.distance(torch.tensor([3.0, 2 * math.pi - 0.5, 9.0, 1.0])) == pytest.approx(
        math.sqrt(0.5**2 + 0.25**2 + 2**2 + 1**2)
    )
    assert points.distance(torch.tensor([1.0 + 2 * math.pi, 0.0, 3.0, 0.0])) == pytest.approx(math.pi / 2), "no angle"


@pytest.mark.gate
def test_upright_is_nearer_than_hanging():
    upright, hanging = search(Cartpole(), [-1.0] * 4, [1.0] * 4).find({0: 0.5})
    assert_close(upright.x, torch.tensor([0.5, 0, 0, 0]), rtol=0, atol=1e-12)
    assert abs(float(hanging.x[1])) == pytest.approx(math.pi)


def test_of_a_curve_it_is_the_nearest_with_small_controls():
    (point,) = search(Pendulum(), [0.2, -1.0], [0.4, 1.0]).find({1: 0.0})
    assert float(point.x[0]) == pytest.approx(0.3, abs=1e-2)
    assert point.held
    (least,) = search(Pendulum(), [0.2, -1.0], [0.4, 1.0], ControlBox(-2.0, 2.0)).find({1: 0.0})
    assert abs(float(least.u)) <= 2
    assert float(least.x[0]) == pytest.approx(math.asin(2 / 9.81), rel=1e-9), "as near as the limits admit"


def test_a_target_that_is_held_stays_as_it_was_written(caplog):
    problem = problem_of(system=Pendulum(), target=[0.7, 0], controls={})
    assert problem.goal.tolist() == [0.7, 0.0]
    assert not caplog.records
    assert problem_of(system=Pendulum(), target=[0.7, 1e-4], controls={}).goal.tolist() == [0.7, 0.0]
    with pytest.raises(UsageError, match="that some control holds"):
        problem_of(system=Pendulum(), target=[0.7, 0.1], controls={})


def test_a_written_control_is_what_the_cost_counts_from():
    problem = problem_of(target=[0.4, 15], target_control=[0.3])
    assert problem.goal.tolist() == [0.4, 15.0]
    assert problem.rest.tolist() == [0.3]


def run(capsys, tmp_path, *arguments, **changes):
    path = tmp_path / "task.yaml"
    path.write_text(yaml.safe_dump({**TASK, **changes}))
    status = main(["trim", str(path), *arguments])
    return status, capsys.readouterr()


@pytest.mark.gate
def test_trim_prints_the_point(capsys, tmp_path):
    status, output = run(capsys, tmp_path, target={"output voltage": 15})
    assert status == 0
    for words in ("current (A)", "0.454124583", "duty (1)", "0.339388328", "largest rate left", "yes"):
        assert words in output.out
    status, output = run(capsys, tmp_path, "--json", "target={output voltage: 15}", target=[0.1, 15])
    content = json.loads(output.out)
    assert content["states"] == {"current": pytest.approx(CURRENT, rel=1e-12), "output voltage": 15.0}
    assert content["controls"] == {"duty": pytest.approx(DUTY, rel=1e-12)}
    assert content["residual"] < 1e-12
    assert content["within_limits"] is True
    assert content["others"] == []
    assert content["units"]["states"]["current"] == "A"
    content = json.loads(run(capsys, tmp_path, "--json", system={"name": f"{__name__}:Level"}, target={"y": 0})[1].out)
    assert [other["states"]["z"] for other in content["others"]] == [pytest.approx(-2)]


@pytest.mark.parametrize(
    ("changes", "reason"),
    sample([
        ({"target": {"voltge": 15}}, "got 'voltge'; did you mean"),
        ({"target": {"power": 15}}, "name states of the system"),
        ({"target": {1: 15}}, "got 1; name states|got '1'; name states"),
        ({"target": {"current": None}}, "finite numbers, got None for current"),
        ({"target": {"current": "a lot"}}, "got 'a lot' for current"),
        ({"target": {"current": [1]}}, r"got \[1\] for current"),
        ({"target": {"current": {"a": 1}}}, "got {'a': 1} for current"),
        ({"target": {"current": True}}, "got True for current"),
        ({"target": {"current": math.nan}}, "got nan for current"),
        ({"target": {"current": 1e999}}, "got inf for current"),
        ({"target": {"output voltage": 15, "output_voltage": 15}}, "one entry for .*, got two"),
        ({"target": {}}, "target with a state, got none"),
        ({"target": []}, "target with 2 entries .*, got 0"),
        ({"target": [1, 2, 3]}, "target with 2 entries .*, got 3"),
        ({"target": [1, None]}, "got None for output voltage"),
        ({"target": ["x", 1]}, "got 'x' for current"),
        ({"target": [[1], 1]}, r"got \[1\] for current"),
        ({"target": "15 V"}, "target as a number or a list .* got '15 V'"),
        ({"target": True}, "target as a number or a list .* got True"),
        ({"target": {"output voltage": 1e9}}, "some control holds"),
        ({"target": {"output voltage": -5}}, "within its limits|some control holds"),
        ({"target": None}, "target to trim, got none"),
        ({"target": {"output voltage": 15}, "target_control": [0]}, "got target_control"),
        ({"target": {"output voltage": 15}, "family": {"scale": [1, 2]}}, "got a family"),
        ({"target": {"output voltage": 15}, "controls": {"lower": 0.5, "upper": 0.9}}, "within its limits"),
        ({"target": [3, 15]}, "some control holds"),
    ], 4),
)  # fmt: skip
def test_what_cannot_be_trimmed_is_refused_in_a_line(capsys, tmp_path, changes, reason):
    status, output = run(capsys, tmp_path, **changes)
    assert status == 2
    line = output.err.strip().splitlines()[-1]  # on a busy machine after one that says what is being done
    assert line.startswith("error: Expected")
    with pytest.raises(AssertionError, match=reason):
        raise AssertionError(line)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"target": {"output voltage": 15}, "target_control": [0]}, "every state with target_control, got none for"),
        ({"target": None, "target_control": [0]}, "target with target_control, got none"),
        ({"target": [1, 15], "target_control": [math.inf]}, "target_control of finite numbers"),
    ],
)  # fmt: skip
def test_where_every_state_is_to_be_written(changes, reason):
    with pytest.raises(UsageError, match=reason):
        problem_of(**changes)
