"""The one gate for devices: what does not compute here is refused by its name."""

import torch

from lyapnet.base.errors import UsageError, one_line


def require_device(device: str | torch.device, dtype: torch.dtype) -> None:
    """Refuse a device on which no sum of numbers is computed, and a CPU with a number: torch takes cpu:7 for cpu.

    Raises:
        UsageError: naming it.
    """
    try:
        named = torch.device(device)
        if named.type == "cpu" and named.index is not None:
            raise RuntimeError("the CPU has no number")
        torch.ones(1, dtype=dtype, device=named).sum().item()  # the device meta has tensors without numbers in them
    except (RuntimeError, AssertionError, TypeError) as error:
        raise UsageError(
            f"Expected a device that computes here, cpu or cuda, got {str(device)!r} ({one_line(error)}); choose one."
        ) from error
