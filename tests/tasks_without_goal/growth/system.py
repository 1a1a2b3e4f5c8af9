"""How much a country consumes and how much it invests, when habits change slowly.

Source: Ramsey, "A mathematical theory of saving", 1928; Barro, Sala-i-Martin, "Economic growth", 2004, chapter 2.
"""

import torch

import lyapnet


class Growth(lyapnet.ControlAffineSystem):
    """k̇ = k^α − δ k − c, ċ = u c, and the discount factor ḋ = −ρ d."""

    state_names, state_units = ("capital", "consumption", "discount"), ("", "1/year", "")
    control_names, control_units = ("change",), ("1/year",)

    def __init__(self, share: float = 0.33, depreciation: float = 0.06, impatience: float = 0.03):
        super().__init__()
        self.share, self.depreciation, self.impatience = share, depreciation, impatience

    def f(self, x):
        capital, consumption, discount = x.unbind(-1)
        invested = capital**self.share - self.depreciation * capital - consumption
        return torch.stack([invested, torch.zeros_like(capital), -self.impatience * discount], -1)

    def g(self, x):
        consumption = x[..., 1]
        return torch.stack([0 * consumption, consumption, 0 * consumption], -1)[..., None]


class Displeasure(lyapnet.Cost):
    """The negative utility, logarithmic, of what is consumed and of what is left to those who come after."""

    def state(self, x):
        return -x[..., 2] * torch.log(x[..., 1])

    def R(self, x):
        return x.new_full((*x.shape[:-1], 1, 1), 0.5)

    def terminal(self, x):
        return -4 * x[..., 2] * torch.log(x[..., 0])
