"""Twelve temperatures along a bar that four heaters keep, each end of the bar in the open.

Source: the heat equation in twelve pieces, as in Kwakernaak, Sivan, "Linear optimal control systems", 1972.
"""

import torch

from lyapnet.task.systems import Linear


class Bar(Linear):
    """Ṫ_i = 4 (T_{i−1} − 2 T_i + T_{i+1}) + T_i + heat, by heaters at every third piece."""

    def __init__(self, pieces: int = 12):
        between = torch.ones(pieces - 1).diag(1)
        exchange = 4 * (between + between.mT - 2 * torch.eye(pieces)) + torch.eye(pieces)
        super().__init__(exchange, torch.eye(pieces)[:, 1::3])
