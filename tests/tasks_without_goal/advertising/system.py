"""Advertising that wins customers and forgetting that loses them.

Source: Vidale, Wolfe, "An operations-research study of sales response to advertising", 1957; with a cost of effort that
is convex, as in Sethi, "Optimal control of the Vidale-Wolfe advertising model", 1973.
"""

import lyapnet


class Advertising(lyapnet.ControlAffineSystem):
    """ṡ = ρ u (1 − s) − δ s, s the share of the market."""

    state_names, state_units = ("share",), ("",)
    control_names, control_units = ("effort",), ("",)

    def __init__(self, response: float = 0.4, forgetting: float = 0.3):
        super().__init__()
        self.response, self.forgetting = response, forgetting  # 1/year

    def f(self, x):
        return -self.forgetting * x

    def g(self, x):
        return (self.response * (1 - x))[..., None]


class Loss(lyapnet.Cost):
    """The negative profit of five years in millions: what customers bring, and what effort costs."""

    def state(self, x):
        return -3 * x[..., 0]

    def R(self, x):
        return x.new_full((*x.shape[:-1], 1, 1), 0.25)

    def terminal(self, x):
        return -2 * x[..., 0]
