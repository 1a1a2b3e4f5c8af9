"""The gates for what others wrote: functions of each state alone, in batches of every size, that remember nothing."""

from lyapnet.contracts.batch_sizes import check_batch_sizes
from lyapnet.contracts.functions import called, check_function, copied, initialised, remedy
from lyapnet.contracts.memory import Memory, check_memory, reaches_own_code

__all__ = [
    "Memory", "called", "check_batch_sizes", "check_function", "check_memory", "copied", "initialised",
    "reaches_own_code", "remedy",
]  # fmt: skip
