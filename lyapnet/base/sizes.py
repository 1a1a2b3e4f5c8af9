"""Checks of memory sizes by estimates, before anything is allocated.

The estimates are lower bounds: a refused size cannot work, but an accepted one may still be too large.
"""

from pathlib import Path
from typing import Any

from lyapnet.base.errors import UsageError

NUMBER = 8  # bytes of a number
COPIES = 4  # numbers for each weight in training: the weight, its gradient, and two of Adam
THREADS = 1024  # largest number of threads, more than usual machines have cores


def free_memory() -> int:
    """The free memory of the machine or the limit of its container, in bytes."""
    found = [2**63]
    try:
        lines = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        found.append(1024 * int(lines["MemAvailable"].split()[0]))
        found.append(int(Path("/sys/fs/cgroup/memory.max").read_text()))
    except (OSError, LookupError, ValueError):  # another system, or no limit
        pass
    return min(found)


def require_memory(name: str, got: Any, size: int, remedy: str) -> None:
    """Check that a size in bytes does not exceed the free memory.

    Raises:
        UsageError: it does; states both.
    """
    free = free_memory()
    if size > free:
        amounts = "about {:.3g} GB, {:.3g} GB are free".format(*(min(v, 10**300) / 1e9 for v in (size, free)))
        raise UsageError(f"Expected {name} that fits into memory, got {str(got)[:60]} ({amounts}); {remedy}.")


def size_of_loops(states: int, steps: int, n: int) -> int:
    """The bytes of closed loops: x, u and V at each node."""
    return NUMBER * states * (steps + 1) * (n + 2)


def check_sizes(config: Any) -> None:
    """Check that the weights and one closed loop of a config fit into memory.

    Raises:
        UsageError: they do not; names the key.
    """
    n, hidden = len(config.initial_states.lower), config.network.hidden or []
    # twice: V, and its copy for the check of its contract
    require_memory("network.hidden", hidden, 2 * NUMBER * _weights(n, hidden), "choose smaller widths")
    steps = config.horizon.steps
    require_memory("horizon.steps", steps, size_of_loops(1, steps, n), "choose fewer")


def check_training_sizes(config: Any) -> None:
    """Check that the training of a config fits into memory.

    Raises:
        UsageError: it does not; names the key.
    """
    n, steps, hidden, options = (
        len(config.initial_states.lower),
        config.horizon.steps,
        config.network.hidden or [],
        config.evaluation,
    )
    learner = 10_000 + COPIES * NUMBER * _weights(n, hidden)
    require_memory("network.hidden", hidden, learner, "choose smaller widths")
    require_memory("seeds", config.seeds, config.seeds * learner, "train fewer at once")
    for name, states in (
        ("training.batch_size", config.training.batch_size),
        ("evaluation.validation_states", options.validation_states),
    ):
        require_memory(name, states, size_of_loops(states * config.seeds, steps, n), "choose fewer")
    test = size_of_loops(options.test_states, steps, n)
    require_memory("evaluation.test_states", options.test_states, test, "choose fewer")
    certified = NUMBER * n * options.certified_states
    require_memory("evaluation.certified_states", options.certified_states, certified, "choose fewer")
    if config.pointwise.weight != 0:  # null: the program's default
        points = NUMBER * config.pointwise.points * max([n, *hidden])
        require_memory("pointwise.points", config.pointwise.points, points, "choose fewer")


def _weights(n: int, hidden: list[int]) -> int:
    """A lower bound of the number of weights: those between the layers."""
    return sum(one * other for one, other in zip([n, *hidden], [*hidden, 1], strict=True))
