"""Names of tasks and methods for readers."""

ALGORITHMS = {"ppo": "PPO", "sac": "SAC"}
PLANNERS = {"rest": "no control", "lqr": "LQR", "ilqr": "iLQR"}


def name_of(task: str) -> str:
    """A task for readers."""
    return task.replace("_", " ")


def method_name(method: str) -> str:
    """A method for readers: PPO (tuned), MPC (25 % of T)."""
    algorithm, _, setting = method.partition("_")
    if algorithm == "mpc":
        return f"MPC ({setting} % of T)"
    if algorithm in ALGORITHMS and setting:
        return f"{ALGORITHMS[algorithm]} ({setting})"
    return PLANNERS.get(method, method)
