"""Configs that the tests share: a small one, the shipped ones, and classes of a user's own."""

from pathlib import Path

from lyapnet.experiment.assembly import build_problem, build_program, build_rollout, build_value_function

CONF = Path(__file__).parents[1] / "conf"
SCRATCH = CONF / "from_scratch"
EXPERIMENTS = [path for path in CONF.rglob("*.yaml") if not path.stem.startswith("compare")]
PLAIN = """
experiment: small
program: {name: lyapunov, margin: 0.1}
system: {name: double_integrator}
cost: {Q: [1, 1], R: [1], Q_T: [1, 1]}
initial_states: {lower: [-1, -1], upper: [1, 1]}
horizon: {steps: 4, dt: 0.1}
network: {name: anchored, hidden: [4]}
training: {iterations: 1, batch_size: 2}
evaluation: {validation_states: 2, test_states: 2, animate: false}
"""

HANGAR = """
import torch
from lightning.pytorch import Callback
from torch import nn
from lyapnet import ControlAffineSystem, Cost, ValueFunction

class Balloon(ControlAffineSystem):
    state_names, state_units = ("height", "speed"), ("m", "m/s")
    control_names, control_units = ("thrust",), ("N",)
    mass = 1.0

    def f(self, x):
        return torch.stack([x[..., 1], -x[..., 1] ** 3], -1)

    def g(self, x):
        return torch.stack([torch.zeros_like(x[..., :1]), torch.ones_like(x[..., :1]) / self.mass], -2)

class Drone(Balloon):
    def __init__(self, mass=1.0):
        super().__init__()
        self.mass = mass

class Squadron(Balloon):
    def __init__(self, **parameters):
        super().__init__()
        self.mass = parameters["mass"]

class Greedy(Callback):
    def __init__(self, appetite):
        self.appetite = appetite

class Bowl(ValueFunction):
    def __init__(self, scaling, hidden=(4,)):
        super().__init__()
        self.width = hidden[0]
        self.weight = nn.Parameter(torch.ones(()))

    def forward(self, t, x):
        return self.weight * (x**2).sum(-1) + 0 * t

class Price(Cost):
    def state(self, x):
        return (x**2).sum(-1)

    def R(self, x):
        return torch.ones_like(x[..., :1, None])

    def terminal(self, x):
        return (x**2).sum(-1)
"""


def objects(config):
    """Everything that a config names, built: the problem, V, the program, the rollout."""
    problem = build_problem(config)
    V = build_value_function(config, problem)
    return problem, V, build_program(config), build_rollout(config, problem, V)
