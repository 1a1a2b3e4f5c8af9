"""Sound claims about families, whose parameters are constant states."""

import pytest
import torch

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.claims.funnel import prove_funnel
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import config_from_plain
from lyapnet.loop.rollout import Rollout
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.task.sets import Box
from lyapnet.value.policy import HJBPolicy


class Decay(lyapnet.ControlAffineSystem):
    """ẋ = −kx + u."""

    state_names, state_units, control_names, control_units = ("x",), ("m",), ("u",), ("m/s",)

    def __init__(self, k: float = 1.0):
        super().__init__()
        self.k = k

    def f(self, x):
        return torch.stack([-self.k * x[..., 0]], -1)

    def g(self, x):
        return torch.ones(*x.shape, 1).to(x)


class Square(lyapnet.ValueFunction):
    """V = x²."""

    def forward(self, t, x):
        return x[..., 0] ** 2 + 0 * t


@pytest.mark.gate
def test_a_funnel_of_a_family_has_no_members_beside_it():
    """A parameter is constant: D is its range, no closed loop leaves D along it, and other k do not count."""
    task = build_problem(config_from_plain({
        "experiment": "decay", "system": {"name": f"{__name__}:Decay"}, "cost": {"Q": [1], "R": [1], "Q_T": [1]},
        "initial_states": {"lower": [-1], "upper": [1]}, "horizon": {"steps": 10, "dt": 0.05},
        "family": {"k": [0.8, 1.2]},
    }))  # fmt: skip
    loop = Rollout(task, HJBPolicy(task, Square())).closed_loop
    claim = prove_funnel(loop, task, 0.5, 0.3, budget=Budget(60))
    assert claim.verdict == "certified"
    assert (claim.states.lower[1], claim.states.upper[1]) == (0.8, 1.2)
    with pytest.raises(UsageError, match="Expected a set around X₀"):
        prove_funnel(loop, task, 0.5, 0.3, Box([-2.0, 0.9], [2.0, 1.2]))
    task.system.constants = (0, 1)
    with pytest.raises(UsageError, match="Expected ẋ = 0 for the constants of a system"):
        prove_funnel(loop, task, 0.5, 0.3, Box([-2.0, 0.8], [2.0, 1.2]))
