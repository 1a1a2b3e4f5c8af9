"""A fed batch of yeast that makes a protein and secretes it; too much glucose stops the making.

Source: Park, Ramirez, "Optimal production of secreted protein in fed-batch reactors", 1988.
"""

import torch

import lyapnet


class Reactor(lyapnet.ControlAffineSystem):
    """Concentrations of secreted and of all protein, of cells and of glucose in a volume that the feed fills."""

    state_names = ("secreted", "protein", "cells", "glucose", "volume")
    state_units = ("1/l", "1/l", "g/l", "g/l", "l")
    control_names, control_units = ("feed",), ("l/h",)

    def f(self, x):
        secreted, protein, cells, glucose, _ = x.unbind(-1)
        growth = 21.87 * glucose / ((glucose + 0.4) * (glucose + 62.5))
        making = glucose * torch.exp(-5 * glucose) / (0.1 + glucose)
        secretion = 4.75 * growth / (0.12 + growth)
        return torch.stack(
            [
                secretion * (protein - secreted),
                making * cells,
                growth * cells,
                -7.3 * growth * cells,
                torch.zeros_like(cells),
            ],
            -1,
        )

    def g(self, x):
        secreted, protein, cells, glucose, volume = x.unbind(-1)
        inflow = torch.stack([-secreted, -protein, -cells, 20 - glucose, volume], -1)
        return (inflow / volume[..., None])[..., None]


class Shortage(lyapnet.Cost):
    """The negative amount of protein that is secreted in the end, and what the feed costs."""

    def state(self, x):
        return torch.zeros_like(x[..., 0])

    def R(self, x):
        return x.new_full((*x.shape[:-1], 1, 1), 0.5)

    def terminal(self, x):
        return -x[..., 0] * x[..., 4]
