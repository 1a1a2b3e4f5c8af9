"""Benchmarks: time, memory and error of the ways to compute gradients, of enclosures and of controls."""

from lyapnet.lab.bench.accuracy import Accuracy, gradient_accuracy
from lyapnet.lab.bench.cases import Case, is_chain, load_case
from lyapnet.lab.bench.measurement import BenchRow, time_routes, use_threads
from lyapnet.lab.bench.routes import BASELINE, ROUTES, routes_for

__all__ = [
    "BASELINE",
    "ROUTES",
    "Accuracy",
    "BenchRow",
    "Case",
    "gradient_accuracy",
    "is_chain",
    "load_case",
    "routes_for",
    "time_routes",
    "use_threads",
]
