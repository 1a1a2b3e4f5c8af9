"""Names of tasks and methods for readers."""

ALGORITHMS = {"ppo": "PPO", "sac": "SAC"}


def name_of(task: str) -> str:
    """A task for readers."""
    return task.replace("_", " ")


def method_name(method: str) -> str:
    """A method for readers: PPO (tuned)."""
    algorithm, _, setting = method.partition("_")
    return f"{ALGORITHMS[algorithm]} ({setting})" if algorithm in ALGORITHMS and setting else method
