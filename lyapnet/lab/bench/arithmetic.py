"""The arithmetic that a closed loop and its gradient need, and the machine's rate of it."""

from functools import partial

import torch
from torch.utils.flop_counter import FlopCounterMode

from lyapnet.lab.bench.cases import Case
from lyapnet.lab.bench.routes import timed

GRADIENT_FACTOR = 3  # backpropagation takes two more products of the same size for each product of the closed loop
SIDE, PRODUCTS = 1024, 10  # rows of the square matrices of `peak_rate`; number of products that are timed


def multiply_adds(case: Case) -> float:
    """The multiply-adds of the matrix products of V and V_x along one closed loop, once at each step.

    V_x takes as many as V. Other operations, as tanh, are not counted, and neither is what a law evaluates besides.
    """
    (x0,) = case.sample(1)
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        case.V(torch.zeros_like(x0[:1]), x0[None])
    return 2 * case.problem.horizon.steps * counter.get_total_flops() / 2  # two operations are one multiply-add


def peak_rate(dtype: torch.dtype) -> float:
    """Most multiply-adds per second in products of large matrices in torch, on as many threads as torch uses now."""
    A, B = torch.rand(2, SIDE, SIDE, dtype=dtype)
    return SIDE**3 / min(timed(partial(torch.mm, A, B))[1] for _ in range(PRODUCTS))
