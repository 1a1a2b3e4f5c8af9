"""Controls without weight between limits: the least weight that works, and its price."""

import pytest
import torch

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.assembly.classes import Parts
from lyapnet.experiment.config import config_from_plain

TASK = {
    "experiment": "usage", "system": {"name": "linear", "parameters": {"A": [[0]], "B": [[1, 1]]}},
    "cost": {"Q": 1, "R": 0, "Q_T": 1}, "controls": {"lower": 0, "upper": 30}, "target": [20],
    "initial_states": {"lower": 0, "upper": 15}, "horizon": {"steps": 20, "dt": 0.1},
}  # fmt: skip


class Far(lyapnet.Cost):
    """As far as can be at the end, whatever the control."""

    def state(self, x):
        return 0 * x[..., 0]

    def R(self, x):
        return x.new_zeros(2, 2).expand(*x.shape[:-1], 2, 2)

    def terminal(self, x):
        return (x[..., 0] - 100) ** 2


def refusal(parts=None, **changes):
    with pytest.raises(UsageError) as error:
        build_problem(config_from_plain({**TASK, **changes}), parts)
    return str(error.value)


def test_the_least_weight_is_named_with_its_price():
    message = refusal()
    assert "Expected a weight in R for every control, got none for" in message
    assert "write cost.R=0.001, about the least that works, which adds at most 3.6 to costs of 5" in message
    weighted = build_problem(config_from_plain({**TASK, "cost": {"Q": 1, "R": 0.001, "Q_T": 1}}))
    u = torch.full((2,), 30.0)
    assert 2 * float(weighted.cost.control(torch.zeros(1), u)) == pytest.approx(3.6)  # T uᵀRu


def test_those_that_have_a_weight_keep_it():
    assert "'cost.R=[0.1, 0.002]'" in refusal(cost={"Q": 1, "R": [0.1, 0], "Q_T": 1})
    assert "on the diagonal of R" in refusal(cost={"Q": 1, "R": [[1, 1], [1, 1]], "Q_T": 1})
    assert "on the diagonal of R" in refusal(Parts(cost=Far()), cost={"name": f"{__name__}:Far"}, target=None)


@pytest.mark.parametrize(
    "changes",
    [
        {"controls": {"lower": 0}},
        {"controls": {}},
        {"cost": {"Q": 1, "R": -1, "Q_T": 1}},
        {"cost": {"Q": 0, "R": 0, "Q_T": 0}},
        {"cost": {"Q": 1, "R": [[1, 2], [2, 1]], "Q_T": 1}},
    ],
)
def test_other_faults_of_R_are_refused_as_before(changes):
    assert "symmetric positive definite" in refusal(**changes)
