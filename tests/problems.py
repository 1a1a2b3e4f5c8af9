"""What the tests share: problems in one line, and toy value functions."""

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor, nn

from lyapnet.base.interpolation import Curve
from lyapnet.controller.controller import Controller
from lyapnet.experiment.assembly import build_problem, build_program, build_rollout, build_value_function
from lyapnet.experiment.config import load_config
from lyapnet.loop.rollout import ClosedLoop
from lyapnet.task.cost import Cost, QuadraticCost
from lyapnet.task.horizon import Horizon
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box, ControlSet, Unbounded
from lyapnet.task.systems import SYSTEMS, ControlAffineSystem
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.expansions import Expansion
from lyapnet.value.networks import ExpansionNetwork
from lyapnet.value.policy import HJBPolicy, SampledPolicy

CONF = Path(__file__).parents[1] / "conf"
AMPLE = 300.0  # wall seconds that no proof of a test takes, on a busy machine too: what bounds it is its boxes
AFFINE = [name for name, cls in SYSTEMS.items() if issubclass(cls, ControlAffineSystem)]
KINDS = ("double_integrator", "cartpole", "reacher", "satellite")  # systems, one of each kind of f, g and R


def problem_of(
    system: ControlAffineSystem,
    cost: Cost | None = None,
    steps: int = 10,
    dt: float = 0.1,
    initial_states: Box | None = None,
    controls: ControlSet | None = None,
    method: str = "euler",
) -> Problem:
    """A problem of a system: with Q = I, R = I, Q_T = I, no limits, and X₀ = [−1, 1]ⁿ unless told otherwise."""
    cost = QuadraticCost(torch.eye(system.n), torch.eye(system.m), torch.eye(system.n)) if cost is None else cost
    box = Box([-1.0] * system.n, [1.0] * system.n) if initial_states is None else initial_states
    return Problem(system, cost, Unbounded() if controls is None else controls, box, Horizon(steps, dt, method))


def untrained(name: str, *overrides: str) -> Controller:
    """The controller of conf/from_scratch/NAME.yaml, or conf/NAME.yaml, with fresh weights."""
    scratch = CONF / "from_scratch" / f"{name}.yaml"
    config = load_config(scratch if scratch.exists() else CONF / f"{name}.yaml", overrides)
    problem = build_problem(config)
    V = build_value_function(config, problem)
    return Controller(problem, V, build_rollout(config, problem, V), build_program(config), config)


def hjb_loop(system: ControlAffineSystem, cost: Cost, V: ValueFunction) -> ClosedLoop:
    """The closed loop of the HJB policy of V."""
    problem = problem_of(system, cost)
    return ClosedLoop(problem, HJBPolicy(problem, V))


class Quadratic(ValueFunction):
    """V = xᵀPx from P (n, n), or xᵀP_n x at the nodes t = n·dt from P (N + 1, n, n); its gradient is autograd's."""

    def __init__(self, P, dt: float = 1.0):
        super().__init__()
        P = torch.as_tensor(P, dtype=torch.get_default_dtype())
        self.P = nn.Parameter(P if P.ndim == 3 else P[None])
        self.dt = dt

    def forward(self, t, x):
        P = self.P[(t / self.dt).round().long().clamp(0, len(self.P) - 1)]
        return ((P @ x[..., None])[..., 0] * x).sum(-1)


class Formula(ValueFunction):
    """V(t, x) = f(t, x) for any function of tensors; its gradient is autograd's."""

    def __init__(self, f: Callable[[Tensor, Tensor], Tensor]):
        super().__init__()
        self.f = f

    def forward(self, t, x):
        return self.f(t, x)


def with_expansion(V: ValueFunction) -> ValueFunction:
    """An ExpansionNetwork around a random path, with random weights for its zeros; any other V as it is."""
    if isinstance(V, ExpansionNetwork):
        nn.init.normal_(V.network.output.weight)
        t = torch.linspace(0, V.network.inputs.duration, 9)
        wave = 1 + 0.3 * torch.sin(3 * t)[:, None]
        root = torch.randn(V.n, V.n)
        H = wave[..., None] * (root @ root.mT)
        V.start_from_expansion(
            t, 0.1 * wave * torch.randn(V.n), wave[:, 0], wave * torch.randn(V.n), H, 1.1 * H, torch.randn(1, 20, V.n)
        )
    return V


class OfExpansion(ValueFunction):
    """V of a single expansion, c + pᵀδ + ½ δᵀHδ at the nodes of a problem's horizon; c and the rest may be scaled."""

    made_for = SampledPolicy

    def __init__(self, problem: Problem, expansion: Expansion, share: float = 1.0, constant: float = 1.0):
        super().__init__()
        x, c, p, H = expansion
        n = self.n = x.shape[-1]
        self.share, self.constant, self.weight = share, constant, nn.Parameter(torch.ones(()))
        self.parts = Curve(problem.horizon.times(c), torch.cat([c[:, None], p, x, H.flatten(1)], 1))
        assert self.parts(torch.zeros(())).shape == (1 + 2 * n + n * n,)

    def forward(self, t: Tensor, x: Tensor) -> Tensor:
        n, parts = self.n, self.parts(t)
        p, delta, H = parts[..., 1 : 1 + n], x - parts[..., 1 + n : 1 + 2 * n], self.curvature(t)
        rest = ((p + (H @ delta[..., None])[..., 0] / 2) * delta).sum(-1)
        return self.weight * (self.constant * parts[..., 0] + self.share * rest)

    def curvature(self, t: Tensor) -> Tensor:
        return self.parts(t)[..., 1 + 2 * self.n :].unflatten(-1, (self.n, self.n))
