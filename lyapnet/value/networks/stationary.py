"""V(x) without time, for infinite-horizon regulation: exact at the goal by construction, positive elsewhere."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from lyapnet.base.types import PerState, State, Time
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.networks.base import Scaling
from lyapnet.value.networks.expansion import standard_widths
from lyapnet.value.networks.fcn import FCN


class StationaryNetwork(ValueFunction):
    """V(x) = s h(w) e^{ρ(w) N(η)} with w = ‖ξ‖², ξ = Cᵀ(x − x*), h(w) = 2(√(1 + w) − 1) and ρ = w/(1 + w).

    C and s are such that s w = ½ δᵀHδ is the value of the regulator linearised at the goal. Hence V(x*) = 0, V > 0
    elsewhere, and V_xx(x*) = H for any weights: around the goal V is a Lyapunov function, and u is the regulator's.
    Far away s h grows like a norm and e^N corrects it, so that errors of V are relative. s is the value up to
    which the regulator is accurate; it may be much smaller than V on X₀. To resolve both scales the inputs of N are
    compressed, η_i = ξ_i / (1 + ξ_i²)^¼; (sin θ, cos θ) of chosen angles are further inputs.

    Args:
        scaling: magnitudes of the task, for a network without regulator.
        hidden, activation: layers of the FCN N; None: two layers of 64, or of 128 for five states and more.
        embedded_angles: indices of the states whose sine and cosine are further inputs of N.
    """

    goal: Float[Tensor, " n"]
    scale: Float[Tensor, ""]  # s, in units of cost
    coordinates: Float[Tensor, "n n"]  # C
    angles: Int[Tensor, " k"]

    def __init__(
        self,
        scaling: Scaling,
        hidden: Sequence[int] | None = None,
        activation: str = "tanh",
        embedded_angles: Sequence[int] = (),
    ):
        super().__init__()
        n = self.n = len(scaling.state)
        inputs = Scaling([1.0] * (n + 2 * len(embedded_angles)), 1.0, 1.0)
        self.network = FCN(inputs, standard_widths(n) if hidden is None else hidden, activation)
        nn.init.zeros_(self.network.output.weight)
        nn.init.zeros_(self.network.output.bias)
        self.register_buffer("goal", torch.zeros(n))
        self.register_buffer("scale", torch.tensor(scaling.value))
        self.register_buffer("coordinates", torch.diag(1 / torch.tensor(scaling.state)))
        self.register_buffer("angles", torch.tensor(embedded_angles, dtype=torch.long), persistent=False)

    def forward(self, t: Time, x: State) -> PerState:
        xi, root, share = self._around(x)
        N = self.network(x.new_zeros(()), self._inputs(x, xi))
        return self._regulator(xi, root) * torch.exp(share * N)

    def value_and_state_gradient(self, t: Time, x: State) -> tuple[PerState, State]:
        """V and V_x = e^{ρN} (s h' w_x + s h (N ρ' w_x + ρ N_x)), w_x = 2Cξ, h' = 1/√(1 + w), ρ' = 1/(1 + w)²."""
        xi, root, share = self._around(x)
        N, slope = self.network.value_and_state_gradient(x.new_zeros(()), self._inputs(x, xi))
        known, bend = self._regulator(xi, root), torch.exp(share * N)
        along = 2 * (self.scale / root + known * N / root**4)[..., None] * xi
        xi_2 = 1 + xi**2
        along = along + (known * share)[..., None] * slope[..., : self.n] * (1 + xi_2) / (2 * xi_2 * xi_2.sqrt().sqrt())
        return known * bend, bend[..., None] * (
            along @ self.coordinates.mT + self._angle_gradient(x, known * share, slope)
        )

    def curvature(self, t: Time) -> Tensor:
        """H = 2s CCᵀ, the curvature of the regulator's value."""
        return 2 * self.scale * (self.coordinates @ self.coordinates.mT).expand(*t.shape, -1, -1)

    def _around(self, x: State) -> tuple[State, PerState, PerState]:
        """ξ, √(1 + w) and ρ."""
        xi = (x - self.goal) @ self.coordinates
        w = (xi**2).sum(-1)
        return xi, torch.sqrt(1 + w), w / (1 + w)

    def _regulator(self, xi: State, root: PerState) -> PerState:
        """s h(w), computed as 2sw/(√(1 + w) + 1) to avoid cancellation near the goal."""
        return 2 * self.scale * (xi**2).sum(-1) / (root + 1)

    def _inputs(self, x: State, xi: State) -> Tensor:
        """The inputs of N: η, and the sines and cosines."""
        eta = xi / (1 + xi**2).sqrt().sqrt()
        if not len(self.angles):
            return eta
        theta = x[..., self.angles]
        return torch.cat([eta, torch.sin(theta), torch.cos(theta)], -1)

    def _angle_gradient(self, x: State, weight: PerState, slope: Tensor) -> State | float:
        """The contribution of the sines and cosines to V_x."""
        if not len(self.angles):
            return 0.0
        theta, (sine, cosine) = x[..., self.angles], slope[..., self.n :].chunk(2, -1)
        turning = weight[..., None] * (sine * theta.cos() - cosine * theta.sin())
        return torch.zeros_like(x).index_add(-1, self.angles, turning)

    @torch.no_grad()
    def start_from_regulator(self, goal: State, hessian: Tensor, scale: float) -> None:
        """Initialise from the regulator's value ½ δᵀHδ at the goal.

        Args:
            hessian: H (n, n), symmetric positive semidefinite.
            scale: s, the value up to which the regulator is used.
        """
        values, vectors = torch.linalg.eigh(hessian / 2)
        values = values.clamp_min(1e-9 * float(values.max()))
        self.goal.copy_(goal)
        self.scale.fill_(scale)
        self.coordinates.copy_(vectors * (values / scale).sqrt())


class Timeless(ValueFunction):
    """V(t, x) = N(0, x), a stationary V from any network.

    Args:
        network: N.
    """

    def __init__(self, network: ValueFunction):
        super().__init__()
        self.network = network

    def forward(self, t: Time, x: State) -> PerState:
        return self.network(torch.zeros_like(t), x)

    def value_and_state_gradient(self, t: Time, x: State) -> tuple[PerState, State]:
        """V and V_x."""
        return self.network.value_and_state_gradient(torch.zeros_like(t), x)

    def curvature(self, t: Time) -> Tensor | None:
        return self.network.curvature(torch.zeros_like(t))
