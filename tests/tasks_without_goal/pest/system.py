"""A crop, the pest that eats it and the enemy that eats the pest; spraying kills both, enemies can be released.

Source: Goh, Leitmann, Vincent, "Optimal control of a prey-predator system", 1974; Rafikov, Balthazar, "Optimal pest
control problem in population dynamics", 2005.
"""

import torch

import lyapnet


class Field(lyapnet.ControlAffineSystem):
    """Logistic crop and pest, and a predator of Lotka and Volterra."""

    state_names, state_units = ("crop", "pest", "enemy"), ("t/ha", "1000/ha", "1000/ha")
    control_names, control_units = ("spraying", "release"), ("1/day", "1000/ha/day")

    def f(self, x):
        crop, pest, enemy = x.unbind(-1)
        return torch.stack(
            [
                0.08 * crop * (1 - crop / 8) - 0.01 * pest * crop,
                0.2 * pest * (1 - pest / 15) - 0.1 * pest * enemy,
                0.02 * pest * enemy - 0.08 * enemy,
            ],
            -1,
        )

    def g(self, x):
        _, pest, enemy = x.unbind(-1)
        none = torch.zeros_like(pest)
        spraying = torch.stack([none, -pest, -0.6 * enemy], -1)
        release = torch.stack([none, none, none + 1], -1)
        return torch.stack([spraying, release], -1)


class Loss(lyapnet.Cost):
    """The negative income from the crop after forty days, and what sprays and enemies cost, in €/ha."""

    def state(self, x):
        return torch.zeros_like(x[..., 0])

    def R(self, x):
        return torch.diag(x.new_tensor([300.0, 200.0])).expand(*x.shape[:-1], 2, 2)

    def terminal(self, x):
        return -150 * x[..., 0]
