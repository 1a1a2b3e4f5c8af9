"""Names of the weights of a quadratic cost, which may be parameters of a family."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import torch

from lyapnet.base.errors import UsageError, did_you_mean
from lyapnet.base.names import with_underscores
from lyapnet.experiment.assembly.classes import section
from lyapnet.experiment.assembly.entries import repeated, rows
from lyapnet.experiment.config import CostConfig
from lyapnet.task.cost import COSTS, MATRICES, Cost, CostWrapper, DiagonalWeights, QuadraticCost
from lyapnet.task.systems import ControlSystem

PREFIXES = ("cost.", *(f"{matrix}_" for matrix in MATRICES))  # prefixes of names of weights


class Weight(NamedTuple):
    """A diagonal entry of a matrix of the quadratic cost."""

    matrix: str  # Q, R or Q_T
    i: int


def named(parameters: Mapping[str, Any], system: ControlSystem) -> dict[str, Any]:
    """Parameters of a family with a unique name for each weight, such as R_torque for cost.R.0 and cost.R.torque.

    Raises:
        UsageError: a weight is named twice.
    """
    spellings = _spellings(system)
    found = {spellings.get(name, name): value for name, value in parameters.items()}
    if len(found) < len(parameters):
        raise UsageError(f"Expected each weight of the cost once, got {', '.join(parameters)}; leave one of them out.")
    return found


def weights_among(names: Iterable[str], system: ControlSystem) -> dict[str, Weight]:
    """The weights of the cost among the names in a family's config, by their unique names.

    Raises:
        UsageError: a name has the form of a weight, but there is no such weight.
    """
    spellings, weights = _spellings(system), weights_of(system)
    for name in names:
        if name.startswith(PREFIXES) and name not in spellings and not hasattr(system, name):
            hint = did_you_mean(name, spellings, "name an entry of a diagonal.", "family.")
            raise UsageError(f"Expected family.{name} among {', '.join(weights)}, got no such weight; {hint}")
    return {spellings[name]: weights[spellings[name]] for name in names if name in spellings}


def weights_of(system: ControlSystem) -> dict[str, Weight]:
    """The weights of a quadratic cost by name: Q_STATE, R_CONTROL and Q_T_STATE, with _ for spaces."""
    entries = {matrix: system.control_names if matrix == "R" else system.state_names for matrix in MATRICES}
    return {
        f"{matrix}_{with_underscores(entry)}": Weight(matrix, i)
        for matrix, names in entries.items() for i, entry in enumerate(names)
    }  # fmt: skip


def _spellings(system: ControlSystem) -> dict[str, str]:
    """cost.R.0, cost.R.torque and R_torque ↦ R_torque; the last is left out if it is a parameter of the system."""
    found = dict[str, str]()
    for name, (matrix, i) in weights_of(system).items():
        entry = name.removeprefix(f"{matrix}_")
        short = [] if hasattr(system, name) else [name]
        found |= dict.fromkeys((f"cost.{matrix}.{i}", f"cost.{matrix}.{entry}", *short), name)
    return found


def weighted_matrices(
    config: CostConfig, cost: Cost, weights: Mapping[str, Weight], least: Sequence[float], own: bool
) -> DiagonalWeights:
    """The matrices of a quadratic cost as functions of some weights.

    Args:
        cost: the cost of the config.
        least: the smallest value of each weight.
        own: whether the cost is the user's object instead.

    Raises:
        UsageError: the cost has no such matrices in the config, or a matrix is not definite with the smallest weights.
    """
    while isinstance(cost, CostWrapper):
        cost = cost.cost
    names = ", ".join(weights)
    if own or config.name not in COSTS or not isinstance(cost, QuadraticCost):
        raise UsageError(
            f"Expected cost.Q, cost.R and cost.Q_T in the config for the weights {names} of a family, got a cost of "
            "your own; leave the weights out, or let f read them as parameters of the system."
        )
    if any(matrix == "R" for matrix, _ in weights.values()) and isinstance(config.R, str):
        raise UsageError(f"Expected cost.R in numbers for the weights {names} of a family, got {config.R}; give some.")
    with section("family"):
        return DiagonalWeights(cost, list(weights.values()), torch.tensor(least, dtype=torch.float64))


def with_weights(config: CostConfig, values: Mapping[Weight, float], system: ControlSystem) -> dict[str, Any]:
    """The matrices of a quadratic cost that have weights, as rows, with given values of the weights."""
    matrices = dict[str, list[list[float]]]()
    for (matrix, i), value in values.items():
        written = rows(matrix, repeated(getattr(config, matrix), system.m if matrix == "R" else system.n))
        matrices.setdefault(matrix, torch.as_tensor(written, dtype=torch.float64).tolist())[i][i] = value
    return matrices
