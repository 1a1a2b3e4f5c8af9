"""A user's module: a system, a network, a program, a callback and a logger, none of which the package knows."""

from dataclasses import dataclass

import lightning
import torch
from lightning.pytorch.loggers import Logger

import lyapnet


class Pendulum(lyapnet.ControlAffineSystem):
    """An inverted pendulum."""

    state_names, state_units = ("angle", "rate"), ("rad", "rad/s")
    control_names, control_units = ("torque",), ("N m",)

    def f(self, x):
        return torch.stack([x[..., 1], 2 * torch.sin(x[..., 0]) - 0.1 * x[..., 1]], -1)

    def g(self, x):
        return torch.tensor([[0.0], [1.0]]).to(x).expand(*x.shape, 1)


class Network(lyapnet.ValueFunction):
    """A V whose gradient is autograd's."""

    def __init__(self, scaling=None, hidden=(16,)):
        super().__init__()
        (width,) = hidden
        self.layers = torch.nn.Sequential(torch.nn.Linear(3, width), torch.nn.Tanh(), torch.nn.Linear(width, 1))

    def forward(self, t, x):
        return self.layers(torch.cat([t.expand(x.shape[:-1])[..., None], x], -1))[..., 0]


@dataclass(frozen=True)
class AbsoluteProgram(lyapnet.Program):
    """C = Σ_n |V_{n+1} − V_n + Δt ℓ_n| and B = |V(T, x_N) − φ(x_N)|; promises J within `promise` of V(0, x₀)."""

    degree = 1

    promise: float = 0.5

    def tolerances(self, radius=None, cost=None):
        return lyapnet.Tolerances(radius, None, self.promise if cost is None else cost)

    def penalty(self, excess):
        return excess.abs()

    def constraint_loss(self, values, trajectory):
        return (values.diff(dim=0) + trajectory.step_cost).abs().sum(0)

    def terminal_term(self, values, trajectory):
        return (values[-1] - trajectory.terminal_cost).abs()


class CostOfValidations(lightning.Callback):
    """Keeps the mean cost of each validation, across interruptions too."""

    def __init__(self):
        self.costs = []

    def state_dict(self):
        return {"costs": self.costs}

    def load_state_dict(self, state_dict):
        self.costs = state_dict["costs"]

    def on_validation_end(self, trainer, pl_module):
        if not trainer.sanity_checking:
            self.costs.append(pl_module.members[0].validation.summary()["cost_mean"])


class ListLogger(Logger):
    """Keeps what it is given."""

    def __init__(self):
        super().__init__()
        self.metrics, self.images = {}, {}

    @property
    def name(self):
        return "list"

    @property
    def version(self):
        return 0

    def log_hyperparams(self, params, *args, **kwargs):
        self.params = params

    def log_metrics(self, metrics, step=None):
        for tag, value in metrics.items():
            self.metrics.setdefault(tag, []).append((step, value))

    def log_image(self, key, images, step=None):
        self.images.setdefault(key, []).append((step, images))
