"""Healthy, tumour and immune cells under a drug that kills all three.

Source: de Pillis, Radunskaya, "The dynamics of an optimally controlled tumor model: a case study", 2003.
"""

import torch

import lyapnet


class Patient(lyapnet.ControlAffineSystem):
    """Cells in units of what the tissue carries, the drug in the blood in units of a dose."""

    state_names, state_units = ("healthy", "tumour", "immune", "drug"), ("", "", "", "")
    control_names, control_units = ("dose",), ("1/day",)

    def f(self, x):
        healthy, tumour, immune, drug = x.unbind(-1)
        killing = 1 - torch.exp(-drug)
        return torch.stack(
            [
                healthy * (1 - healthy) - tumour * healthy - 0.15 * killing * healthy,
                1.5 * tumour * (1 - tumour) - 0.5 * immune * tumour - tumour * healthy - 0.3 * killing * tumour,
                0.33
                + 0.01 * immune * tumour / (0.3 + tumour)
                - immune * tumour
                - 0.2 * immune
                - 0.2 * killing * immune,
                -drug,
            ],
            -1,
        )

    def g(self, x):
        return x.new_tensor([[0.0], [0.0], [0.0], [1.0]]).expand(*x.shape[:-1], 4, 1)


class Burden(lyapnet.Cost):
    """The tumour along the way, less what is healthy in the end, and the dose squared."""

    def state(self, x):
        return x[..., 1]

    def R(self, x):
        return x.new_full((*x.shape[:-1], 1, 1), 0.2)

    def terminal(self, x):
        return 40 * x[..., 1] - 5 * x[..., 0]
