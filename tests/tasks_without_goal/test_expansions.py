"""Optima and expansions of tasks without a goal, where a pass without second derivatives of F has no minimum."""

import pytest
import torch

from lyapnet.value.expansions import at_rest, optimal_trajectories, path_under
from tests.tasks_without_goal.tasks import optima_of, problem_of

STATES = 4
APART = 1e-3  # how far apart states are for differences, as a share of X₀


def optima_from(problem, x0):
    return optimal_trajectories(problem, x0, path_under(problem, at_rest(problem), x0).u)


@pytest.fixture(scope="module", params=["glider", "orbit"])
def found(request):
    """A task, its limits of states left out as no optimum comes near them, and optima of its first states."""
    torch.set_default_dtype(torch.float64)
    problem, kept = problem_of(request.param).replaced(constraints=None), optima_of(request.param)
    x0 = torch.tensor(kept["states"])[:STATES]
    return problem, torch.tensor(kept["optima"]), optima_from(problem, x0)


@pytest.mark.gate
def test_optima_against_the_transcription(found):
    _, optima, optimum = found
    assert ((optimum.path.cost - optima[:STATES]).abs() < 1e-3 * optima.std()).all()


@pytest.mark.gate
def test_the_expansion_has_the_slope_and_the_curvature_of_optima_beside(found):
    """Central differences of optima that are sought anew, along each component in which X₀ extends."""
    problem, _, optimum = found
    box, x0 = problem.initial_states, optimum.path.x[0]
    for i in torch.nonzero(box.upper > box.lower).flatten():
        step = APART * (box.upper - box.lower)[i]
        beside = x0.new_zeros(x0.shape[-1]).index_fill(0, i, step)
        below, above = (optima_from(problem, x0 + sign * beside).path.cost for sign in (-1, 1))
        slope, curvature = optimum.expansion.gradient[0, :, i], optimum.expansion.hessian[0, :, i, i]
        scale = slope.abs().max()
        assert ((above - below) / (2 * step) - slope).abs().max() < 2e-3 * scale
        second = (above - 2 * optimum.path.cost + below) / step
        assert (second - step * curvature).abs().max() < 2e-3 * scale
