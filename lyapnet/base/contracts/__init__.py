"""Checks of users' code: functions of each state separately, for batches of every size, without memory."""

from lyapnet.base.contracts.derivatives import TO_WRITE, without_slope
from lyapnet.base.contracts.functions import (
    call_checked,
    check_function,
    check_result,
    copied,
    remedy,
    require_initialised,
)
from lyapnet.base.contracts.jumps import SLOPE, Jump, jumps
from lyapnet.base.contracts.memory import Memory, check_memory, differences, reaches_own_code, state_of

__all__ = [
    "SLOPE",
    "TO_WRITE",
    "Jump",
    "Memory",
    "call_checked",
    "check_function",
    "check_memory",
    "check_result",
    "copied",
    "differences",
    "jumps",
    "reaches_own_code",
    "remedy",
    "require_initialised",
    "state_of",
    "without_slope",
]  # fmt: skip
