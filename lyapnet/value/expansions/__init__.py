"""Optimal trajectories, and second order expansions of the value function around them."""

from lyapnet.value.expansions.control_search import derivatives_of, minimise_over_controls
from lyapnet.value.expansions.dynamic_programming import (
    FLOOR,
    TRIES,
    Optimum,
    follow_expansions,
    optimal_trajectories,
    penalty_of_one_step,
    regulator,
    riccati,
    sizes,
    without_penalty,
)
from lyapnet.value.expansions.laws import (
    Expansion,
    at_rest,
    certainty_equivalents,
    greedy_law,
    held_control,
    step_objective,
)
from lyapnet.value.expansions.noisy_loops import expansion_of_another_way, expansion_under_noise
from lyapnet.value.expansions.paths import Path, cheapest, exchanged, in_float64, path_of, path_under

__all__ = [
    "FLOOR",
    "TRIES",
    "Expansion",
    "Optimum",
    "Path",
    "at_rest",
    "certainty_equivalents",
    "cheapest",
    "derivatives_of",
    "exchanged",
    "expansion_of_another_way",
    "expansion_under_noise",
    "follow_expansions",
    "greedy_law",
    "held_control",
    "in_float64",
    "minimise_over_controls",
    "optimal_trajectories",
    "path_of",
    "path_under",
    "penalty_of_one_step",
    "regulator",
    "riccati",
    "sizes",
    "step_objective",
    "without_penalty",
]
