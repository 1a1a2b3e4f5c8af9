"""What each route to the gradient costs, and what it gets wrong: seconds, memory and error side by side."""

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
