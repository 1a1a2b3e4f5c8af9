"""The arithmetic that a closed loop and its gradient need, and the machine's rate of it."""

from functools import partial

import torch

from lyapnet.lab.bench.cases import Case
from lyapnet.lab.bench.routes import timed

VALUE_AND_SLOPE = 2  # products with each matrix of weights: one for V, one for V_x
GRADIENT_FACTOR = 3  # backpropagation takes two more products of the same size for each product of the closed loop
SIDE, PRODUCTS = 1024, 10  # rows of the square matrices of `peak_rate`; number of products that are timed


def multiply_adds(case: Case) -> int:
    """The multiply-adds that V and V_x need along one closed loop, once at each step: two for each weight of a matrix.

    Other operations, as tanh, are not counted, and neither is what a network or a law evaluates besides.
    """
    weights = sum(p.numel() for p in case.V.parameters() if p.ndim == 2)
    return VALUE_AND_SLOPE * weights * case.problem.horizon.steps


def peak_rate(dtype: torch.dtype) -> float:
    """Most multiply-adds per second in products of large matrices in torch, on as many threads as torch uses now."""
    A, B = torch.rand(2, SIDE, SIDE, dtype=dtype)
    return SIDE**3 / min(timed(partial(torch.mm, A, B))[1] for _ in range(PRODUCTS))
