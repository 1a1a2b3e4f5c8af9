"""Readable names of tasks and methods."""

from lyapnet.lab.comparison.results import WITH_VALUE

ALGORITHMS = {"ppo": "PPO", "sac": "SAC"}
PLANNERS = {"rest": "no control", "lqr": "LQR", "ilqr": "iLQR"}


def name_of(task: str) -> str:
    """The readable name of a task."""
    return task.replace("_", " ")


def method_name(method: str) -> str:
    """The readable name of a method, such as PPO (tuned) or MPC (25 % of T)."""
    algorithm, _, setting = method.partition("_")
    if method.startswith(WITH_VALUE):
        return f"MPC ({method.removeprefix(WITH_VALUE)} steps + V)"
    if algorithm == "mpc":
        return f"MPC ({setting} % of T)"
    if algorithm in ALGORITHMS and setting:
        return f"{ALGORITHMS[algorithm]} ({setting})"
    return PLANNERS.get(method, method)
