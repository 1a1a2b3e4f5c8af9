"""A network added to an expansion of V to second order around a trajectory, known before training."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lyapnet.base.interpolation import Curve, SmoothCurve
from lyapnet.base.linear_algebra import apply
from lyapnet.base.types import PerState, State, Time
from lyapnet.task.domain import Border
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.networks.base import Scaling
from lyapnet.value.networks.fcn import FCN
from lyapnet.value.networks.near_borders import NearBorders

NARROW_STATES = 4  # largest number of states for which narrow layers are sufficient
SINGULAR_SHARE = 1e-6  # curvature relative to the largest, below which a direction counts as flat
MIN_SPREAD = 1e-6  # spread relative to a state's magnitude, below which it counts as zero
ROUNDING = 1e-12  # V at the goal relative to s, below which it counts as zero
NODES = 65  # nodes of the piecewise linear curves in time; expansions with more nodes are thinned out


def standard_widths(n: int) -> list[int]:
    """The widths of the hidden layers for n states."""
    return [64 if n <= NARROW_STATES else 128] * 2


class ExpansionNetwork(ValueFunction):
    """V(t, x) = c(t) + p(t)ᵀδ + ½ δᵀH(t)δ + s ρ(ξ) N(t, ξ), ξ = Cᵀδ, δ = x − x̄(t); N is zero before training.

    * ρ: if c = 0, around a goal that is an equilibrium, ρ = ‖ξ‖²/(1 + ‖ξ‖²), so that V and V_x remain zero there and
      errors of V are small near the goal. Otherwise ρ = 1.
    * C: in the coordinates ξ the expansion has equal curvature in all directions, H ≈ 2s CCᵀ. A small correction of V
      then changes u = −½R⁻¹gᵀV_x only a little. In units of X₀ this change can be huge, along a direction in which V is
      flat and g is large. Without an expansion V = s N and C = diag(1/scale), or diag(1/spread) about a centre x̄ once
      optima are known.
    * Constant states p, the parameters of a family, are separate from the other states y: ξ is
      (Cᵀ(δy + Sδp), δp / spread) with S = H_yy⁻¹H_yp, so that V's valley is ξ_y = 0, and N depends on p even where the
      expansion is flat in it. ρ depends on ξ_y only.
    * Weights of the cost, of which p has the logarithms, scale V over decades. Around a goal δ_i is replaced in the
      expansion by exp(Σ_k A_ik(t) δp_k) δ_i, whose factor has the growth of the Riccati solution's H_ii with each
      weight, and s grows with the mean of these factors at t = 0.
    * If f, g, q or φ are undefined beyond borders of some states, the logarithms of the distances to these borders are
      further inputs of N.
    * If the expansion equals φ at T, N is multiplied by 1 − t/T. Then V(T, ·) = φ for any weights, and V is close to
      the expansion near T, where the remaining cost is too small to learn from.

    Args:
        scaling: magnitudes of the task, for a network without expansion.
        hidden, activation: layers of the FCN N; None: two layers of 64, or of 128 for five states and more.
        constants: indices of the constant states.
        borders: borders of the domain, with the indices of their states.
        weights: indices of the constant states that are logarithms of weights of the cost.
        smooth: whether c, p, x̄ and H are smooth in time, as sound certificates require, or piecewise linear.
    """

    scale: Float[Tensor, ""]  # s, in units of cost
    placed: Float[Tensor, "k n"]  # rows of the identity at the weights
    size_rates: Float[Tensor, " k"]  # growth of s with each of the weights' logarithms
    coordinates: Float[Tensor, "n n"]  # C
    at_goal: Float[Tensor, ""]  # 1 or 0: ρ = 1 − at_goal / (1 + ‖ξ‖²)
    moves: Float[Tensor, " n"]  # 0 for a constant state, 1 for any other
    ends: Float[Tensor, ""]  # 1 if the expansion is φ at T, else 0

    def __init__(
        self,
        scaling: Scaling,
        hidden: Sequence[int] | None = None,
        activation: str = "tanh",
        constants: Sequence[int] = (),
        smooth: bool = False,
        borders: Sequence[tuple[int, Border]] = (),
        weights: Sequence[int] = (),
    ):
        super().__init__()
        self.constants, self.weights = list(constants), list(weights)
        n = self.n = len(scaling.state)
        hidden = standard_widths(n) if hidden is None else hidden
        self.near_borders = NearBorders(borders) if borders else None
        self.network = FCN(Scaling([1.0] * (n + len(borders)), scaling.duration, 1.0), hidden, activation)
        nn.init.zeros_(self.network.output.weight)
        nn.init.zeros_(self.network.output.bias)
        self.register_buffer("scale", torch.tensor(scaling.value))
        self.register_buffer("coordinates", torch.diag(1 / torch.tensor(scaling.state)))
        self.register_buffer("at_goal", torch.tensor(0.0))
        self.register_buffer(
            "moves", torch.ones(n).index_fill(0, torch.tensor(self.constants, dtype=torch.long), 0.0), persistent=False
        )
        T, parts = scaling.duration, 1 + 2 * n + 2 * n * n + n * len(self.weights)
        nodes = torch.linspace(0, T, NODES)
        self.expansion = SmoothCurve(T, [parts]) if smooth else Curve(nodes, torch.zeros(NODES, parts))
        self.duration = T
        self.register_buffer("ends", torch.tensor(0.0))
        self.register_buffer("placed", torch.eye(n)[self.weights], persistent=False)
        if self.weights:
            self.register_buffer("size_rates", torch.zeros(len(self.weights)))

    def forward(self, t: Time, x: State) -> PerState:
        c, p, H, delta = self._around(t, x)
        xi = delta @ self.coordinates
        rest = self._fading(t, 1 - self.at_goal * self._near(xi)) * self.network(t, self._inputs(x, xi))
        if self.weights:
            delta, rest = self._growth(t, delta) * delta, self._size(delta) * rest
        return c + ((p + apply(H, delta) / 2) * delta).sum(-1) + self.scale * rest

    def value_and_state_gradient(self, t: Time, x: State) -> tuple[PerState, State]:
        """V and V_x = p + Hδ + s C (ρ N_ξ + N ρ_ξ); with weights of the cost, by the chain rule of their factors."""
        c, p, H, delta = self._around(t, x)
        xi = delta @ self.coordinates
        N, slopes = self.network.value_and_state_gradient(t, self._inputs(x, xi))
        near = self._near(xi)
        share = self._fading(t, 1 - self.at_goal * near)
        rest = share * N
        slope = self._fading(t, 2 * self.at_goal * near**2)
        rest_xi = share[..., None] * slopes[..., : self.n] + (slope * N)[..., None] * self._moving(xi)
        rest_x = rest_xi @ self.coordinates.mT
        if self.near_borders is not None:
            rest_x = rest_x + self.near_borders.pull_back(x, share[..., None] * slopes[..., self.n :])
        if not self.weights:
            curved = apply(H, delta)
            return c + ((p + curved / 2) * delta).sum(-1) + self.scale * rest, p + curved + self.scale * rest_x
        factor, size, A = self._growth(t, delta), self._size(delta), self._rates(t)
        grown = factor * delta
        curved = apply(H, grown)
        steep = p + curved
        by_weights = apply(A.mT, steep * grown) + self.scale * (size * rest)[..., None] * self.size_rates
        value = c + ((p + curved / 2) * grown).sum(-1) + self.scale * size * rest
        gradient = factor * steep + self.scale * size[..., None] * rest_x
        return value, gradient + by_weights @ self.placed

    def _rates(self, t: Time) -> Tensor:
        """A(t), (*batch, n, number of weights)."""
        return self.expansion(t)[..., 1 + 2 * self.n + 2 * self.n**2 :].unflatten(-1, (self.n, len(self.weights)))

    def _growth(self, t: Time, delta: State) -> State:
        """exp(A(t) δp): the factor of each state in the expansion; 1 for the constant states."""
        return torch.exp(apply(self._rates(t), delta @ self.placed.mT))

    def _size(self, delta: State) -> PerState:
        """The factor of s."""
        return torch.exp((delta @ self.placed.mT * self.size_rates).sum(-1))

    def _inputs(self, x: State, xi: State) -> Tensor:
        """The inputs of N: ξ, and the logarithms of distances to borders."""
        return xi if self.near_borders is None else torch.cat([xi, self.near_borders(x)], -1)

    def _fading(self, t: Time, rho: PerState) -> PerState:
        """ρ or its slope, times 1 − t/T if the expansion is φ at T."""
        return rho * (1 - self.ends * t / self.duration)

    def _near(self, xi: State) -> PerState:
        """1 / (1 + ‖ξ_y‖²)."""
        return 1 / (1 + (self._moving(xi) ** 2).sum(-1))

    def _moving(self, xi: State) -> State:
        """ξ_y, with zeros for the constant states."""
        return self.moves * xi if self.constants else xi

    def curvature(self, t: Time) -> Tensor:
        start = 1 + 2 * self.n + self.n**2
        return self.expansion(t)[..., start : start + self.n**2].unflatten(-1, (self.n, self.n))

    def curvature_at(self, t: Time, x: State) -> Tensor:
        H = self.curvature(t)
        if not self.weights:
            return H
        factor = self._growth(t, self._around(t, x)[-1])
        return factor[..., :, None] * H * factor[..., None, :]

    def _around(self, t: Time, x: State) -> tuple[Tensor, Tensor, Tensor, State]:
        """(c, p, H) at t, and δ."""
        n = self.n
        parts = self.expansion(t)
        H = parts[..., 1 + 2 * n : 1 + 2 * n + n * n].unflatten(-1, (n, n))
        return parts[..., 0], parts[..., 1 : 1 + n], H, x - parts[..., 1 + n : 1 + 2 * n]

    def _fit_curves(self, t: Tensor, parts: Tensor, exact_end: bool = False) -> None:
        """Fit the curves to the nodes; H is made exactly symmetric, as the formula of V_x assumes."""
        self.expansion.fit(t, parts)
        self.ends.fill_(float(exact_end))
        if isinstance(self.expansion, SmoothCurve):
            for fitted in (self.expansion.end, self.expansion.weights):
                start = 1 + 2 * self.n
                H = fitted[..., start : start + 2 * self.n**2].unflatten(-1, (2, self.n, self.n))
                H.copy_((H + H.mT) / 2)

    @torch.no_grad()
    def raise_by(self, t: Tensor, rise: Tensor) -> None:
        """Add to c(t) a rise given at nodes t (K,); curves that are smooth in time stay as they are."""
        if isinstance(self.expansion, Curve):
            self.expansion.values[:, 0] += Curve(t, rise[:, None])(self.expansion.nodes)[:, 0]

    @torch.no_grad()
    def start_from_zero(self, t: Tensor, centre: Tensor, curvature: Tensor, spread: Tensor, value: float) -> None:
        """Initialise at V = 0, with the inputs of N scaled by a spread around a centre; training may change V(x*).

        Args:
            t: the nodes (K,).
            centre: x̄ (n,), the same at all times.
            curvature: model of V_xx for control laws, (K, n, n), symmetric positive semidefinite.
            spread: spread of each state, (n,).
            value: s.
        """
        none = torch.zeros(len(t), 1 + self.n).to(centre)
        parts = [none, centre.expand(len(t), -1), torch.zeros_like(curvature).flatten(1), curvature.flatten(1)]
        self._fit_curves(t, torch.cat([*parts, none.new_zeros(len(t), self.n * len(self.weights))], 1))
        self.at_goal.fill_(0)
        self.scale.fill_(value)
        magnitude = 1 / self.coordinates.diagonal()
        self.coordinates.copy_(torch.diag(1 / spread.where(spread > MIN_SPREAD * magnitude, magnitude)))

    @torch.no_grad()
    def start_from_expansion(
        self,
        t: Tensor,
        x: Tensor,
        value: Tensor,
        gradient: Tensor,
        hessian: Tensor,
        curvature: Tensor,
        spread: Tensor,
        growth: Tensor | None = None,
        exact_end: bool = False,
    ) -> None:
        """Initialise from an expansion at the nodes t (K,), with parts (K, …).

        Args:
            growth: A (K, n, number of weights); None: zero.
            exact_end: whether the expansion is φ at the last node, for any x.
            curvature: model of H for control laws, (K, n, n), symmetric positive semidefinite.
            spread: samples of deviations δ, (nodes, k, n); s is their mean ½ δᵀHδ, at the node where that is largest,
                divided by the number of states.
        """
        A = value.new_zeros(len(t), self.n, len(self.weights)) if growth is None else growth
        parts = [value[:, None], gradient, x, hessian.flatten(1), curvature.flatten(1), A.flatten(1)]
        self._fit_curves(t, torch.cat(parts, 1), exact_end)
        y, p = [i for i in range(self.n) if i not in self.constants], self.constants
        if self.weights:
            self.size_rates.copy_(2 * A[0, y].mean(0))
        early = slice(max(1, 3 * len(curvature) // 4))
        values, vectors = torch.linalg.eigh(curvature[early][:, y][..., y].mean(0) / 2)
        values = values.clamp_min(1e-9 * float(curvature.diagonal(dim1=1, dim2=2).max()))
        inverse = (vectors * values.reciprocal().where(values > SINGULAR_SHARE * values.max(), 0)) @ vectors.mT
        S = inverse @ hessian[early][:, y][..., p].mean(0) / 2
        along = apply(vectors.mT, spread[..., y] + spread[..., p] @ S.mT)
        s = (along**2 * values).sum(-1).mean(-1).max() / len(y)
        self.at_goal.fill_(float(value.abs().max() <= ROUNDING * s))
        s = s.clamp_min(1e-6 * float(value.abs().max()))  # for X₀ of a single point
        if s > 0:
            self.scale.copy_(s)
            C, reach = vectors * (values / s).sqrt(), spread[..., p].abs().amax((0, 1))
            self.coordinates.zero_()
            for k, i in enumerate(y):
                self.coordinates[i, y] = C[k]
            for k, i in enumerate(p):
                self.coordinates[i, y] = S[:, k] @ C
                self.coordinates[i, i] = 1 / reach[k].where(reach[k] > 0, 1)
