"""V(x) without time, for infinite-horizon regulation: exact at the goal by construction, positive elsewhere."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from lyapnet.base.interpolation import ChebyshevProducts, Interpolant, combine
from lyapnet.base.linear_algebra import apply
from lyapnet.base.types import PerState, State, Time
from lyapnet.task.family import Targets
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.networks.base import Scaling
from lyapnet.value.networks.expansion import standard_widths
from lyapnet.value.networks.fcn import FCN

FLAT = 1e-9  # curvature relative to the largest that a direction without any gets, so that V > 0


class StationaryNetwork(ValueFunction):
    """V(x) = s h(w) e^{ρ(w) N(η)} with w = ‖ξ‖², ξ = Cᵀ(x − x*), h(w) = 2(√(1 + w) − 1) and ρ = w/(1 + w).

    C and s are such that s w = ½ δᵀHδ is the value of the regulator linearised at the goal. Hence V(x*) = 0, V > 0
    elsewhere, and V_xx(x*) = H for any weights: around the goal V is a Lyapunov function, and u is the regulator's.
    Far away s h grows like a norm and e^N corrects it, so that errors of V are relative. s is the value up to
    which the regulator is accurate; it may be much smaller than V on X₀. To resolve both scales the inputs of N are
    compressed, η_i = ξ_i / (1 + ξ_i²)^¼; (sin θ, cos θ) of chosen angles are further inputs.

    In a family, x = (y, p), that is so for each member: ξ = GᵀL(p)ᵀ(y − y*(p)) with P(p) = L(p)L(p)ᵀ and s GGᵀ = 1, and
    p, scaled to its range, is a further input of N. y* and L are those of the problem; checkpoints have G alone.

    Args:
        scaling: magnitudes of the task, for a network without regulator.
        hidden, activation: layers of the FCN N; None: two layers of 64, or of 128 for five states and more.
        embedded_angles: indices of the states whose sine and cosine are further inputs of N.
        members: y*(p) and P(p) of a family, whose parameters p are the last states; None: no family.
    """

    goal: Float[Tensor, " n"]
    scale: Float[Tensor, ""]  # s, in units of cost
    coordinates: Float[Tensor, "n n"]  # C, or G of a family
    angles: Int[Tensor, " k"]

    def __init__(
        self,
        scaling: Scaling,
        hidden: Sequence[int] | None = None,
        activation: str = "tanh",
        embedded_angles: Sequence[int] = (),
        members: "Members | None" = None,
    ):
        super().__init__()
        n = len(scaling.state)
        self.members, self.constants = members, 0 if members is None else members.constants
        self.n = n - self.constants
        inputs = Scaling([1.0] * (n + 2 * len(embedded_angles)), 1.0, 1.0)
        self.network = FCN(inputs, standard_widths(n) if hidden is None else hidden, activation)
        nn.init.zeros_(self.network.output.weight)
        nn.init.zeros_(self.network.output.bias)
        self.register_buffer("goal", torch.zeros(n), persistent=members is None)
        self.register_buffer("scale", torch.tensor(scaling.value))
        C = torch.diag(1 / torch.tensor(scaling.state[: self.n]))
        self.register_buffer("coordinates", C if members is None else members.relative(C))
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
        gradient = self._pull_back(x, along, (known * share)[..., None] * slope[..., self.n : self.n + self.constants])
        return known * bend, bend[..., None] * (gradient + self._angle_gradient(x, known * share, slope))

    def curvature(self, t: Time) -> Tensor:
        """H = 2s CCᵀ, the curvature of the regulator's value; in a family that of the member in the middle."""
        x = self.goal if self.members is None else nn.functional.pad(self.members.basis.center, (self.n, 0))
        return self.curvature_at(t, x.expand(*t.shape, -1))

    def curvature_at(self, t: Time, x: State) -> Tensor:
        if self.members is None:
            return 2 * self.scale * (self.coordinates @ self.coordinates.mT).expand(*x.shape[:-1], -1, -1)
        C = torch.eye(x.shape[-1], self.n).to(x) @ self._coordinates_at(x)  # zeros for the parameters
        return 2 * self.scale * C @ C.mT

    def _coordinates_at(self, x: State) -> Tensor:
        """C, of a family C(p) (*batch, n, n)."""
        if self.members is None:
            return self.coordinates
        return combine(self.members.basis(x[..., self.n :]), self.members.roots @ self.coordinates)

    def _from_goal(self, x: State) -> Tensor:
        """x − x*, of a family y − y*(p)."""
        return x - self.goal if self.members is None else x[..., : self.n] - self.members.goal(x[..., self.n :])

    def _around(self, x: State) -> tuple[Tensor, PerState, PerState]:
        """ξ, √(1 + w) and ρ."""
        delta, C = self._from_goal(x), self._coordinates_at(x)
        xi = delta @ C if self.members is None else apply(C.mT, delta)
        w = (xi**2).sum(-1)
        return xi, torch.sqrt(1 + w), w / (1 + w)

    def _regulator(self, xi: Tensor, root: PerState) -> PerState:
        """s h(w), computed as 2sw/(√(1 + w) + 1) to avoid cancellation near the goal."""
        return 2 * self.scale * (xi**2).sum(-1) / (root + 1)

    def _inputs(self, x: State, xi: Tensor) -> Tensor:
        """The inputs of N: η, the scaled parameters of a family, and the sines and cosines."""
        inputs = [xi / (1 + xi**2).sqrt().sqrt()]
        if self.members is not None:
            basis = self.members.basis
            inputs.append((x[..., self.n :] - basis.center) / basis.half_widths)
        if len(self.angles):
            theta = x[..., self.angles]
            inputs += [torch.sin(theta), torch.cos(theta)]
        return torch.cat(inputs, -1) if len(inputs) > 1 else inputs[0]

    def _pull_back(self, x: State, along: Tensor, beside: Tensor) -> State:
        """The gradient in x of a function with gradients `along` in ξ and `beside` in the scaled parameters."""
        C = self._coordinates_at(x)
        if self.members is None:
            return along @ C.mT
        p, gradient = x[..., self.n :], apply(C, along)
        pairs = self._from_goal(x)[..., :, None] * along[..., None, :]
        by_C = self.members.basis.gradient(p, pairs.flatten(-2) @ (self.members.roots @ self.coordinates).flatten(1).mT)
        by_p = by_C - self.members.pull_back(p, gradient) + beside / self.members.basis.half_widths
        return torch.cat([gradient, by_p], -1)

    def _angle_gradient(self, x: State, weight: PerState, slope: Tensor) -> State | float:
        """The contribution of the sines and cosines to V_x."""
        if not len(self.angles):
            return 0.0
        theta, (sine, cosine) = x[..., self.angles], slope[..., self.n + self.constants :].chunk(2, -1)
        turning = weight[..., None] * (sine * theta.cos() - cosine * theta.sin())
        return torch.zeros_like(x).index_add(-1, self.angles, turning)

    @torch.no_grad()
    def start_from_regulator(self, goal: State, hessian: Tensor, scale: float) -> None:
        """Initialise from the regulator's value ½ δᵀHδ at the goal, or from those of the members of a family.

        Args:
            hessian: H (n, n), symmetric positive semidefinite; not read for a family, as `goal` is not.
            scale: s, the value up to which the regulator is used.
        """
        values, vectors = torch.linalg.eigh(hessian / 2 if self.members is None else self.members.middle_cost())
        C = vectors * (values.clamp_min(FLAT * float(values.max())) / scale).sqrt()
        self.goal.copy_(goal)
        self.scale.fill_(scale)
        # of a family ξ is in the middle what it is for that system alone
        self.coordinates.copy_(C if self.members is None else self.members.relative(C))


class Members(nn.Module):
    """The members of a stationary family: y*(p), and L(p) with the regulator's cost ‖L(p)ᵀ(y − y*(p))‖².

    Args:
        targets: p ↦ x*(p) − x*(p̄).
        middle: x*(p̄).
        root: p ↦ L(p) in all states x, lower triangular.
        kept: the indices of the states y among x on which V depends.
    """

    places: Float[Tensor, "n states"]  # rows of the identity
    middle: Float[Tensor, " states"]
    roots: Float[Tensor, "nodes n n"]  # coefficients of L(p), with a small weight on states that cost nothing

    def __init__(self, targets: Targets, middle: Tensor, root: Interpolant, kept: Sequence[int]):
        super().__init__()
        assert isinstance(root.basis, ChebyshevProducts)
        self.targets, self.basis = targets, root.basis
        self.constants: int = len(root.basis.counts)
        places = torch.eye(len(middle))[list(kept)].to(middle)
        roots = places @ root.coefficients @ places.mT
        costs = roots.abs().amax((0, -1))
        roots[0] += torch.diag(torch.where(costs > 0, 0.0, FLAT**0.5 * costs.max()))  # the first function is 1
        for name, value in (("places", places), ("middle", middle), ("roots", roots)):
            self.register_buffer(name, value, persistent=False)

    def goal(self, p: Tensor) -> State:
        """y*(p)."""
        return (self.middle + self.targets.shift(p)) @ self.places.mT

    def pull_back(self, p: Tensor, v: State) -> Tensor:
        """The gradient of vᵀy*(p) in p."""
        return self.targets.pull_back(p, v @ self.places)

    def middle_cost(self) -> Tensor:
        """P(p̄)."""
        L = combine(self.basis(self.basis.center), self.roots)
        return L @ L.mT

    def relative(self, C: Tensor) -> Tensor:
        """G with L(p̄)G = C."""
        return torch.linalg.solve(combine(self.basis(self.basis.center), self.roots), C)


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
