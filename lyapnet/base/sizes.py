"""The one gate for sizes: what cannot fit into memory is refused by an estimate, before anything is allocated.

The estimates are lower bounds: what they refuse cannot work, and what they let through may still be too much.
"""

from pathlib import Path
from typing import Any

from lyapnet.base.errors import UsageError

NUMBER = 8  # bytes
COPIES = 4  # of a weight in training: itself, its gradient, and two of Adam
THREADS = 1024  # more than any machine that this runs on has cores


def free_memory() -> int:
    """Bytes that the machine has left, or that its container may hold."""
    found = [2**63]
    try:
        lines = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        found.append(1024 * int(lines["MemAvailable"].split()[0]))
        found.append(int(Path("/sys/fs/cgroup/memory.max").read_text()))
    except (OSError, LookupError, ValueError):  # another system, or no limit
        pass
    return min(found)


def require_memory(name: str, got: Any, size: int, remedy: str) -> None:
    """Refuse a size that would take more bytes than there are.

    Raises:
        UsageError: naming both.
    """
    free = free_memory()
    if size > free:
        amounts = "about {:.3g} GB, {:.3g} GB are free".format(*(min(v, 10**300) / 1e9 for v in (size, free)))
        raise UsageError(f"Expected {name} that fits into memory, got {str(got)[:60]} ({amounts}); {remedy}.")


def size_of_loops(states: int, steps: int, n: int) -> int:
    """Bytes of closed loops: x, u and V at each node."""
    return NUMBER * states * (steps + 1) * (n + 2)


def check_sizes(config: Any) -> None:
    """Refuse a config of which not even the controller would fit: its weights, or one closed loop.

    Raises:
        UsageError: naming the key.
    """
    n, hidden = len(config.initial_states.lower), config.network.hidden or []
    # twice: V, and the copy of it that is held against its contract
    require_memory("network.hidden", hidden, 2 * NUMBER * _weights(n, hidden), "choose smaller widths")
    steps = config.horizon.steps
    require_memory("horizon.steps", steps, size_of_loops(1, steps, n), "choose fewer")


def check_training_sizes(config: Any) -> None:
    """Refuse a config of which a training would not fit.

    Raises:
        UsageError: naming the key.
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
    if config.pointwise.weight != 0:  # null: the program's own
        points = NUMBER * config.pointwise.points * max([n, *hidden])
        require_memory("pointwise.points", config.pointwise.points, points, "choose fewer")


def _weights(n: int, hidden: list[int]) -> int:
    """The number of weights between layers, at the least."""
    return sum(one * other for one, other in zip([n, *hidden], [*hidden, 1], strict=True))
