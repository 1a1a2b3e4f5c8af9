"""Evaluation of controllers: costs, comparison with optima, robustness, figures."""

from lyapnet.evaluation.measurement import Evaluation, evaluate, evaluation
from lyapnet.evaluation.oracles import Optima, Oracle, Report, oracle_of, silent
from lyapnet.evaluation.states import StateTable, measure

__all__ = [
    "Evaluation",
    "Optima",
    "Oracle",
    "Report",
    "StateTable",
    "evaluate",
    "evaluation",
    "measure",
    "oracle_of",
    "silent",
]
