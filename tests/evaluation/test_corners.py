"""The dearest states of X₀, which uniform draws miss: at its corners, and where a search near the worst leads."""

import itertools

import pytest
import torch
from rich.console import Console

from lyapnet.controller.controller import Controller
from lyapnet.evaluation.measurement import dearest_corner, evaluate
from lyapnet.evaluation.tables import evaluation_table
from lyapnet.task.sets import Box
from lyapnet.task.systems import DoubleIntegrator
from tests.problems import Formula, problem_of


def controller_of(V, lower=(-1.0, -2.0), upper=(3.0, 1.0)):
    return Controller(problem_of(DoubleIntegrator(), initial_states=Box(lower, upper)), Formula(V))


def test_it_is_the_dearest_of_all():
    controller = controller_of(lambda t, x: (x**2).sum(-1))
    found = dearest_corner(controller)
    states = torch.tensor(list(itertools.product((-1.0, 3.0), (-2.0, 1.0))))
    costs = [float(controller.rollout(x).cost) for x in states]
    assert found.count == 4
    assert found.cost == pytest.approx(max(costs))
    assert found.x0 == states[costs.index(max(costs))].tolist()
    assert found.value == pytest.approx(sum(x**2 for x in found.x0))
    assert min(costs) < 0.9 * found.cost


def test_a_search_near_the_worst_states_finds_dearer_ones():
    controller = controller_of(lambda t, x: (x**2).sum(-1) / 4)
    result = evaluate(controller, samples=16, optimum=False)
    found = result["worst_found"]
    assert found["cost"] == pytest.approx(float(controller.rollout(torch.tensor(found["x0"])).cost))
    assert found["value"] == pytest.approx(sum(x**2 for x in found["x0"]) / 4)
    assert found["cost"] > result["cost_max"] > 1.05 * found["value"]
    assert all(low <= x <= high for low, x, high in zip((-1, -2), found["x0"], (3, 1), strict=True))
    console = Console(width=120)
    with console.capture() as text:
        console.print(evaluation_table("some", result))
    assert f"dearest of {found['count']} states near the worst: cost J, V(0, x₀)" in text.get()
    enough = controller_of(lambda t, x: 100 + (x**2).sum(-1) / 4)  # the same law, no state costs more than V
    assert "worst_found" not in evaluate(enough, samples=16, optimum=False)


def test_loops_that_diverge_have_no_cost():
    assert dearest_corner(controller_of(lambda t, x: -1e9 * (x**4).sum(-1))).cost is None
