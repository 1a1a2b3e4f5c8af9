"""The check of torch devices."""

import torch

from lyapnet.base.errors import UsageError, one_line


def require_device(device: str | torch.device, dtype: torch.dtype) -> None:
    """Check that a device can compute, and that a CPU has no index, because torch reads cpu:7 as cpu.

    Raises:
        UsageError: the device is not usable.
    """
    try:
        named = torch.device(device)
        if named.type == "cpu" and named.index is not None:
            raise RuntimeError("the CPU has no number")
        torch.ones(1, dtype=dtype, device=named).sum().item()  # fails on the device meta, whose tensors have no values
    except (RuntimeError, AssertionError, TypeError) as error:
        raise UsageError(
            f"Expected a device that computes here, cpu or cuda, got {str(device)!r} ({one_line(error)}); choose one."
        ) from error
