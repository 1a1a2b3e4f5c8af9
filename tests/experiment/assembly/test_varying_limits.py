"""Limits of controls that depend on the state in a config, and what a controller between them says and does."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from lyapnet.base.errors import ExportError, UsageError
from lyapnet.controller.controller import Controller
from lyapnet.evaluation.figures import trajectories
from lyapnet.evaluation.measurement import evaluate
from lyapnet.exchange.export import export
from lyapnet.exchange.export.c import CompiledLaw
from lyapnet.exchange.export.law import Law
from lyapnet.exchange.view.page import page_of
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import config_from_plain
from lyapnet.lab.comparison.controller_policy import ControllerPolicy
from lyapnet.lab.comparison.environments import Environment
from lyapnet.lab.comparison.reference_problems import bounded_problem
from lyapnet.task.sets import ControlBox
from lyapnet.task.systems import Pendulum
from lyapnet.task.varying_limits import LimitTable, VaryingLimits
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.policy import SampledPolicy, SontagPolicy

AT, UPPER, LOWER = [-2.0, 0.0, 2.0], [7.0, 6.0, 0.7], [-0.7, -5.0, -5.5]
PLAIN = {
    "experiment": "x", "system": {"name": "pendulum"}, "cost": {"Q": 1, "R": 0.1, "Q_T": 10},
    "controls": {"name": "table", "parameters": {"state": "velocity", "at": AT, "upper": UPPER, "lower": LOWER}},
    "initial_states": {"lower": -1, "upper": 1}, "horizon": {"steps": 20, "dt": 0.1},
}  # fmt: skip


class Bowl(ValueFunction):
    """V = 9x₁² + 6x₁x₂ + 2x₂²."""

    def forward(self, t, x):
        return 9 * x[..., 0] ** 2 + 6 * x[..., 0] * x[..., 1] + 2 * x[..., 1] ** 2


def problem(**sections):
    return build_problem(config_from_plain({**PLAIN, **sections}))


def controller(dtype=torch.float64, **sections):
    own = problem(**sections).to(dtype)
    return Controller(own, Bowl().to(dtype), policy=SampledPolicy)


class OfAngle(VaryingLimits):
    """Limits of a user's own."""

    def limits_at(self, x):
        upper = 6 - x[..., :1] ** 2 / 4
        return -upper, upper


class Broken(VaryingLimits):
    def limits_at(self, x):
        raise RuntimeError("no limits today")


def is_within(x, u):
    """Whether controls are within the table to the last bit."""
    x, u = (np.asarray(part, dtype=np.float64) for part in (x, u))
    return (np.interp(x[..., 1], AT, LOWER) <= u[..., 0]) & (u[..., 0] <= np.interp(x[..., 1], AT, UPPER))


def states(count=3000, dtype=torch.float64):
    return (2 * torch.randn(count, 2, generator=torch.Generator().manual_seed(0))).to(dtype)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_what_a_controller_says_is_within_the_limits_and_is_what_its_closed_loop_does(dtype):
    own = controller(dtype)
    for t in (0.0, 1.0, 5.0):
        u = own.policy(t, states(dtype=dtype))
        assert is_within(states(dtype=dtype), u).all()
    shares = own.law(torch.tensor(0.0, dtype=dtype), states(dtype=dtype)).detach()
    assert not is_within(states(), 6 * shares).all(), "controls that leave them"
    loop, system, cost, J = own.rollout(states(50, dtype)), Pendulum(), own.cost, 0.0
    assert isinstance(own.system, Pendulum)
    x, close = loop.x[0], {"rtol": 1e-3, "atol": 1e-3} if dtype == torch.float32 else {}
    for k in range(20):
        u = own.policy(0.1 * k, x)
        assert_close(u, loop.u[k], **close)
        J, x = J + 0.1 * cost.running(x, u), x + 0.1 * system.to(dtype).dynamics(x, u)
        assert_close(x, loop.x[k + 1], **close)
    assert_close(J + cost.terminal(x), loop.cost, **close)
    assert bool((own.law(loop.t[0], loop.x[0]).abs() == 1).any()), "limits that are met"
    assert_close(own.rollout(states(5, dtype), 30).u[:20], own.rollout(states(5, dtype)).u)


@pytest.mark.gate
def test_optimum_and_shares_of_steps_at_limits_are_those_of_the_moving_limits():
    own = controller()
    found = evaluate(own, samples=20)
    assert found["cost_ratio"] > 1 - 1e-9
    assert found["at_limits"]["torque"]["lower"] > 0
    assert found["at_limits"]["torque"]["upper"] > 0


@pytest.mark.gate
@pytest.mark.parametrize("form", ["c", "c in float32", "torch", "onnx"])
def test_an_exported_law_stays_within_the_limits(form, tmp_path):
    if form == "onnx":
        pytest.importorskip("onnxscript")
    own, dtype = controller(), "float32" if form.endswith("float32") else "float64"
    out = tmp_path / {"torch": "law.pt2", "onnx": "law.onnx"}.get(form, "law")
    export(own, out, form.split()[0], dtype=dtype)  # held against the controller on 10 000 states
    if form.startswith("c"):
        law = compiled_in(out, own, dtype)
        t, x = np.zeros(3000), states().numpy()
        assert is_within(x, law.of_many(t, x)[0]).all()


def compiled_in(folder, own, dtype):
    from lyapnet.exchange.export import c

    kind = {"float32": torch.float32, "float64": torch.float64}[dtype]
    return CompiledLaw(folder, Law(own, kind), 1, c.FLAGS, c.Style(c.NAME, kind), None)


@pytest.mark.gate
def test_limits_of_a_users_own_are_not_written_in_another_precision(tmp_path):
    own = controller(controls={"name": f"{__name__}:OfAngle"})
    export(own, tmp_path / "law", "c")
    with pytest.raises(ExportError, match=r"Expected limits of controls from a table, .+, got OfAngle: .+; .+"):
        export(own, tmp_path / "other", "c", dtype="float32")


@pytest.mark.gate
def test_pages_and_figures_show_the_controls_that_act():
    own = controller()
    loop = own.rollout(states(3))
    panel = trajectories(loop, own.problem).axes[2]
    heights = [line.get_ydata() for line in panel.get_lines()]
    low, high = own.controls.limits_at(loop.x[:-1])
    for expected in (loop.u, low, high):
        assert any(np.allclose(y, expected[:, 0, 0]) for y in heights if len(y) == 20)
    assert "a table over velocity" in own._repr_html_()
    pytest.importorskip("plotly")
    assert page_of(own, "x")


def test_an_action_is_the_share_of_the_range_between_the_limits():
    own = controller()
    environment = Environment(own.problem)
    policy, x0 = ControllerPolicy(own, environment.control_scale), np.array([0.8, 0.9])
    observation, _ = environment.reset(options={"state": x0})
    state, total, controls = None, 0.0, []
    for _ in range(20):
        action, state = policy.predict(observation[None], state)
        observation, reward, *_, info = environment.step(action[0])
        total, controls = total + reward, [*controls, info["control"]]
    loop = own.rollout(x0)
    assert total == pytest.approx(-loop.cost, rel=1e-9)
    np.testing.assert_allclose(controls, loop.u, rtol=1e-9)
    with pytest.raises(UsageError, match=r"Expected no control_scale .+, got \[2.0\]; .+"):
        bounded_problem(own.problem, 2.0)


def test_a_target_is_held_within_the_limits_there():
    own = problem(target={"angle": 0.5})
    held = own.controls.applied(own.goal, own.rest)
    assert_close(Pendulum().dynamics(own.goal, held), torch.zeros(2))
    with pytest.raises(UsageError, match=r"Expected the control at the target, .+, got it outside .+ there; .+"):
        problem(target={"angle": 1.2})


@pytest.mark.parametrize(
    ("sections", "words"),
    [
        ({"family": {"mass": [0.9, 1.1]}}, "a family"),
        ({"randomise": {"mass": [0.9, 1.1]}}, "randomise"),
        ({"outputs": {"measure": ["angle"], "noise": 0.1}}, "outputs"),
        ({"cost": {**PLAIN["cost"], "control_costs": [{"name": "absolute", "weight": 1}]}}, "cost.control_costs"),
        ({"controls": {"name": "table", "parameters": {"state": "speed", "at": [0, 1], "upper": [1, 2]}}}, "angle"),
        ({"controls": {"name": f"{__name__}:Broken"}}, "limits_at"),
        ({"cost": {**PLAIN["cost"], "R": 0}}, "R"),
    ],
)
def test_what_does_not_go_with_them_is_refused(sections, words):
    with pytest.raises(UsageError, match=rf"Expected .*{words}.*, got .+[;:,] .+"):
        problem(**sections)
    assert isinstance(problem().controls, LimitTable)


def test_estimators_and_sontags_law_are_refused():
    own = controller()
    with pytest.raises(UsageError, match=r"Expected constant limits .+, got limits that depend on the state; .+"):
        own.with_estimator(measure=["angle"], noise=0.1)
    with pytest.raises(ValueError, match=r"Expected controls without limits .+, got LimitTable; .+"):
        SontagPolicy(own.problem, own.V)


def test_a_record_tells_tables_apart():
    other = {**PLAIN["controls"]["parameters"], "upper": [7.0, 6.5, 0.7]}
    assert problem().differences(problem().record()) == []
    assert problem(controls={"name": "table", "parameters": other}).differences(problem().record())
    assert problem(controls={"lower": -1, "upper": 1}).differences(problem().record())
    assert type(problem(controls={"lower": -1, "upper": 1}).controls) is ControlBox
