"""Interpolation in torch, differentiable, boundable and exportable: measured tables, and curves in time."""

import itertools
import math
import operator
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import reduce

import torch
from jaxtyping import Float
from numpy.typing import ArrayLike
from torch import Tensor, nn

DEGREES = {"linear": 1, "cubic": 3}
COUNTS = (1, 2, 3, 5, 9, 14, 25, 49)  # numbers of polynomials along a parameter that are tried
ALONG_AXIS = 8  # random values of a parameter at which these are tested, besides the ends of its range
ASIDE = 0.71  # place of the other parameters in their ranges meanwhile; in the middle many functions vanish


class Table(nn.Module):
    """y(x₁, …, x_d) through measured values on a grid: piecewise linear, or a natural cubic spline along each axis.

    Let s_i = min(max((x − x_i)/(x_{i+1} − x_i), 0), 1), the share of interval i of an axis below x. The interpolation
    along an axis is a linear map of 1 and s_i (and s_i², s_i³ for cubic), and y is the product of these maps. It uses
    only operators that autograd, interval bounds and CasADi support. Beyond its ends a table is constant. At the kinks
    of a linear table, its nodes, the derivative is that from the left; certificates cover both sides.

    friction = Table([[-2.0, 0.0, 1.0, 2.0]], [-0.4, 0.0, 0.3, 0.35])  # in __init__; one grid for each axis
    f = friction(x[..., 1:2])  # the coordinates along the last axis: (*batch, d) ↦ (*batch,)

    Args:
        grid: the increasing nodes of each of the d axes.
        values: (K₁, …, K_d), one at each node.
        method: linear, or cubic (d²y/dx² continuous, 0 at the ends).

    Raises:
        ValueError: nodes are not increasing, numbers are not finite, or the values do not fit the grid.
    """

    values: Float[Tensor, "*nodes"]

    def __init__(self, grid: Sequence[ArrayLike], values: ArrayLike, method: str = "linear"):
        super().__init__()
        if method not in DEGREES:
            raise ValueError(f"Expected method linear or cubic, got {method!r}.")
        axes = [torch.tensor(nodes, dtype=torch.float64) for nodes in grid]
        table = torch.tensor(values, dtype=torch.float64)
        for axis, nodes in enumerate(axes):
            if nodes.ndim != 1 or len(nodes) < 2 or not bool((nodes.diff() > 0).all() & nodes.isfinite().all()):
                raise ValueError(
                    f"Expected two or more rising nodes on axis {axis}, got {nodes.tolist()}; give the grid as "
                    "[[x₁, x₂, …]], one list for each axis."
                )
        if table.shape != (expected := tuple(map(len, axes))) or not bool(table.isfinite().all()):
            raise ValueError(f"Expected finite values of shape {expected}, got {tuple(table.shape)}; one at each node.")
        self.degree: int = DEGREES[method]
        dtype = torch.get_default_dtype()
        self.register_buffer("values", table.to(dtype), persistent=False)
        for axis, nodes in enumerate(axes):
            self.register_buffer(f"nodes_{axis}", nodes.to(dtype), persistent=False)
            self.register_buffer(f"weights_{axis}", _cardinal(nodes, self.degree).to(dtype), persistent=False)

    def forward(self, x: Float[Tensor, "*batch d"]) -> Float[Tensor, "*batch"]:
        d = self.values.ndim
        if x.shape[-1] != d:
            raise ValueError(f"Expected coordinates (*batch, {d}), got {tuple(x.shape)}; take x[..., i:i+1] for one.")
        y = self.values.expand(*x.shape[:-1], *self.values.shape)
        for axis in range(d):
            share = self._at(axis, x[..., axis])
            y = (share.reshape(*share.shape, *[1] * (d - axis - 1)) * y).sum(axis - d)
        return y

    def _at(self, axis: int, x: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch K"]:
        """The weight of each node along an axis."""
        nodes, weights = getattr(self, f"nodes_{axis}"), getattr(self, f"weights_{axis}")
        s = _share_below(x, nodes)
        basis = torch.cat([torch.ones_like(s[..., :1]), *(s**k for k in range(1, self.degree + 1))], -1)
        return (weights * basis[..., None, :]).sum(-1)


class Basis(nn.Module, ABC):
    """Smooth functions of p (*batch, k), as many as nodes, at which values determine their coefficients."""

    @abstractmethod
    def forward(self, p: Float[Tensor, "*batch k"]) -> Float[Tensor, "*batch nodes"]:
        """The functions at p, as many as `nodes`."""

    @abstractmethod
    def nodes(self) -> Float[Tensor, "nodes k"]:
        """The nodes."""

    def coefficients(self, values: Float[Tensor, "nodes *shape"]) -> Float[Tensor, "nodes *shape"]:
        """c with Σ c_k function_k = values at the nodes."""
        return torch.linalg.solve(self(self.nodes()), values.flatten(1)).unflatten(-1, values.shape[1:])

    @abstractmethod
    def gradient(self, p: Float[Tensor, "*batch k"], c: Float[Tensor, "*batch nodes"]) -> Float[Tensor, "*batch k"]:
        """The gradient of Σ c_k function_k in p."""


class ChebyshevProducts(Basis):
    """Products of Chebyshev polynomials T_i(s₁)T_j(s₂)…, of parameters p (*batch, k) scaled to s ∈ [−1, 1].

    Beyond its range a parameter counts as the nearest end of it.

    Args:
        lower, upper: the range of each parameter, (k,).
        counts: number of polynomials along each parameter; 1 if its range is a point.
    """

    center: Float[Tensor, " k"]
    half_widths: Float[Tensor, " k"]

    def __init__(self, lower: Float[Tensor, " k"], upper: Float[Tensor, " k"], counts: Sequence[int]):
        super().__init__()
        half = (upper - lower) / 2
        self.counts: list[int] = list(counts)
        self.register_buffer("center", (lower + upper) / 2, persistent=False)
        self.register_buffer("half_widths", torch.where(half > 0, half, 1.0), persistent=False)

    def forward(self, p: Float[Tensor, "*batch k"]) -> Float[Tensor, "*batch nodes"]:
        return torch.stack(_products(self._along_axes(p)), -1)

    def gradient(self, p: Float[Tensor, "*batch k"], c: Float[Tensor, "*batch nodes"]) -> Float[Tensor, "*batch k"]:
        """The gradient of Σ c_k function_k in p, by T_i' = i U_{i−1}; beyond the range that at its end."""
        axes, columns = self._along_axes(p), []
        for k, (count, half) in enumerate(zip(self.counts, self.half_widths, strict=True)):
            s = self._scaled(p, k)
            second_kind = _by_recurrence(s, torch.ones_like(s), 2 * s, count)
            slopes = [torch.zeros_like(s), *((i + 1) * U / half for i, U in enumerate(second_kind[: count - 1]))]
            columns.append((c * torch.stack(_products([*axes[:k], slopes, *axes[k + 1 :]]), -1)).sum(-1))
        return torch.stack(columns, -1)

    def _scaled(self, p: Float[Tensor, "*batch k"], k: int) -> Float[Tensor, "*batch"]:
        return ((p[..., k] - self.center[k]) / self.half_widths[k]).clamp(-1.0, 1.0)

    def _along_axes(self, p: Float[Tensor, "*batch k"]) -> list[list[Tensor]]:
        """The polynomials of each parameter."""
        scaled = [self._scaled(p, k) for k in range(len(self.counts))]
        return [_by_recurrence(s, torch.ones_like(s), s, n) for s, n in zip(scaled, self.counts, strict=True)]

    def nodes(self) -> Float[Tensor, "nodes k"]:
        angles = [(torch.arange(count, dtype=torch.float64) + 0.5) * torch.pi / count for count in self.counts]
        scaled = torch.cartesian_prod(*(a.cos() for a in angles)).reshape(-1, len(angles))
        return self.center + self.half_widths * scaled


class FourierSeries(Basis):
    """1, cos φ, …, cos Kφ, sin φ, …, sin Kφ with φ = 2πp/P, of one variable p (*batch, 1).

    Args:
        period: P.
        count: 2K + 1.
    """

    slopes: Float[Tensor, " K"]  # dφ_k/dp of φ_k = kφ

    def __init__(self, period: float, count: int):
        super().__init__()
        self.period, self.highest = period, count // 2
        slopes = torch.arange(1, self.highest + 1, dtype=torch.float64) * (2 * math.pi / period)
        self.register_buffer("slopes", slopes, persistent=False)

    def forward(self, p: Float[Tensor, "*batch k"]) -> Float[Tensor, "*batch nodes"]:
        cosines, sines = self._waves(p)
        return torch.cat([torch.ones_like(p), cosines, sines], -1)

    def gradient(self, p: Float[Tensor, "*batch k"], c: Float[Tensor, "*batch nodes"]) -> Float[Tensor, "*batch k"]:
        cosines, sines = self._waves(p)
        slopes = torch.cat([torch.zeros_like(p), -self.slopes * sines, self.slopes * cosines], -1)
        return (c * slopes).sum(-1, keepdim=True)

    def _waves(self, p: Float[Tensor, "*batch k"]) -> tuple[Tensor, Tensor]:
        """cos kφ and sin kφ for k = 1, …, K, each (*batch, K), by doubling: e^{i(k+m)φ} = e^{ikφ}e^{imφ}."""
        phase = p * (2 * math.pi / self.period)
        cosines, sines = phase.cos(), phase.sin()
        while cosines.shape[-1] < self.highest:
            cos, sin = cosines[..., -1:], sines[..., -1:]
            cosines, sines = (
                torch.cat([cosines, cos * cosines - sin * sines], -1),
                torch.cat([sines, cos * sines + sin * cosines], -1),
            )
        return cosines[..., : self.highest], sines[..., : self.highest]

    def nodes(self) -> Float[Tensor, "nodes k"]:
        count = 2 * self.highest + 1
        return (torch.arange(count, dtype=torch.float64) * (self.period / count))[:, None]


class Interpolant(nn.Module):
    """p (*batch, k) ↦ (*batch, *shape), the sum of functions of a basis through values at its nodes.

    Args:
        basis: functions of p.
        values: (nodes, *shape).
    """

    coefficients: Float[Tensor, "nodes *shape"]

    def __init__(self, basis: Basis, values: Float[Tensor, "nodes *shape"]):
        super().__init__()
        self.basis = basis
        self.register_buffer("coefficients", basis.coefficients(values), persistent=False)

    def forward(self, p: Float[Tensor, "*batch k"]) -> Tensor:
        return combine(self.basis(p), self.coefficients)


def combine(functions: Float[Tensor, "*batch nodes"], coefficients: Float[Tensor, "nodes *shape"]) -> Tensor:
    """Σ c_k function_k, (*batch, *shape)."""
    return (functions @ coefficients.flatten(1)).unflatten(-1, coefficients.shape[1:])


def fewest_products(
    lower: Float[Tensor, " k"],
    upper: Float[Tensor, " k"],
    accurate: Callable[[ChebyshevProducts, Tensor], bool],
    tested: Float[Tensor, "b k"],
    most: int,
) -> ChebyshevProducts | None:
    """Accurate products of the least degree, determined along each parameter alone and then tested together.

    Args:
        accurate: (products, parameters (b, k) between their nodes) ↦ whether the products are accurate there.
        tested: the parameters at which the products are tested together.
        most: the largest number of products that is tried.

    Returns:
        The products; None if none that were tried are accurate.
    """
    widths = upper - lower
    counts = [_count_along(axis, lower, upper, accurate) for axis in range(len(lower))]
    for _ in COUNTS:
        if math.prod(counts) >= most:
            break
        products = ChebyshevProducts(lower, upper, counts)
        if accurate(products, tested):
            return products
        further = [next((more for more in COUNTS if more > count), most) for count in counts]
        counts = [more if w > 0 else 1 for more, w in zip(further, widths.tolist(), strict=True)]
    return None


def _count_along(axis: int, lower: Tensor, upper: Tensor, accurate: Callable[[ChebyshevProducts, Tensor], bool]) -> int:
    """The number of polynomials that are accurate along a parameter, with the other parameters at ASIDE."""
    width = float(upper[axis] - lower[axis])
    if width == 0:
        return 1
    shares = torch.rand(ALONG_AXIS, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    tested = (lower + ASIDE * (upper - lower)).repeat(ALONG_AXIS + 2, 1)
    tested[:, axis] = lower[axis] + width * torch.cat([shares, torch.tensor([0.0, 1.0])])
    first, last = tested[-2], tested[-1]
    for count in COUNTS:
        counts = [count if k == axis else 1 for k in range(len(lower))]
        if accurate(ChebyshevProducts(first, last, counts), tested):
            return count
    return COUNTS[-1]


def _products(axes: Sequence[Sequence[Tensor]]) -> list[Tensor]:
    """The products of one function of each axis."""
    return [reduce(operator.mul, factors) for factors in itertools.product(*axes)]


def _by_recurrence(s: Tensor, first: Tensor, second: Tensor, count: int) -> list[Tensor]:
    """y₀, y₁ and y_k+1 = 2s y_k − y_k−1, `count` of them."""
    terms = [first, second]
    while len(terms) < count:
        terms.append(2 * s * terms[-1] - terms[-2])
    return terms[:count]


class Curve(nn.Module):
    """t (*batch) ↦ (*batch, *shape), piecewise linear between nodes and constant beyond them.

    Its nodes and values are stored in checkpoints, unlike those of a Table, which belongs to a system.

    Args:
        nodes: (K,), increasing.
        values: (K, *shape).
    """

    nodes: Float[Tensor, " K"]
    values: Float[Tensor, "K *shape"]

    def __init__(self, nodes: Float[Tensor, " K"], values: Float[Tensor, "K *shape"]):
        super().__init__()
        self.register_buffer("nodes", nodes.clone())
        self.register_buffer("values", values.clone())

    def forward(self, t: Float[Tensor, "*batch"]) -> Tensor:
        y = self.values.flatten(1)
        return (y[0] + _share_below(t, self.nodes) @ y.diff(dim=0)).unflatten(-1, self.values.shape[1:])

    @torch.no_grad()
    def fit(self, nodes: Float[Tensor, " N"], values: Float[Tensor, "N *shape"]) -> None:
        """Interpolate a greedy selection of the given points, as many as the curve has nodes, with small error.

        If there are fewer points than nodes, midpoints are inserted.
        """
        kept = [0, len(nodes) - 1]
        unit = values.flatten(1) / values.flatten(1).abs().amax(0).clamp_min(torch.finfo(values.dtype).tiny)
        while len(kept) < min(len(self.nodes), len(nodes)):
            kept = sorted([*kept, _furthest_from(nodes, unit, kept)])
        nodes, values = nodes[kept], values[kept]
        while len(nodes) < len(self.nodes):
            i = int(nodes.diff().argmax())
            nodes, values = (
                torch.cat([y[: i + 1], (y[i : i + 1] + y[i + 1 : i + 2]) / 2, y[i + 1 :]]) for y in (nodes, values)
            )
        self.nodes.copy_(nodes)
        self.values.copy_(values)


class SmoothCurve(nn.Module):
    """t (*batch) ↦ (*batch, *shape) on [0, T], smooth: y(T) + Σ_k a_k (σ((τ − τ_k)/w) − σ((0 − τ_k)/w)), with

        τ = log(1 + (T − t)/s) / log(1 + T/s)

    the remaining time on a logarithmic scale, stretched where it is below s. Unlike a Curve it has no kinks, at which
    V_t would jump and bounds of V̇ would have to include both slopes. It approximates a solution of the Riccati equation
    to five or six digits. Its coefficients are stored in checkpoints.

    Args:
        duration: T.
        shape: shape of y.
    """

    scale: Float[Tensor, ""]  # s
    end: Float[Tensor, "*shape"]  # y(T)
    weights: Float[Tensor, "K *shape"]  # a

    STEPS = torch.arange(-2, 27, dtype=torch.float64) / 24  # τ_k
    WIDTH = 1.5 / 24  # w
    SCALES = (0.025, 0.05, 0.1, 0.2, 0.4)  # candidates for s, relative to T
    RIDGE = 1e-9  # weight of the regularisation Σ a² relative to Σ error², in units of y
    BETWEEN = 8  # points of the fit in each interval between nodes

    def __init__(self, duration: float, shape: Sequence[int]):
        super().__init__()
        self.duration = duration
        self.register_buffer("scale", torch.tensor(self.SCALES[-1] * duration))
        self.register_buffer("end", torch.zeros(*shape))
        self.register_buffer("weights", torch.zeros(len(self.STEPS), *shape))

    def forward(self, t: Float[Tensor, "*batch"]) -> Tensor:
        y = self.end.flatten() + self._basis(t, self.scale) @ self.weights.flatten(1)
        return y.unflatten(-1, self.end.shape)

    def _basis(self, t: Float[Tensor, "*batch"], scale: Tensor) -> Float[Tensor, "*batch K"]:
        """The basis functions: the factor of each a_k."""
        return self._sigmoids(t, scale) - torch.sigmoid(-self.STEPS.to(t) / self.WIDTH)

    def _sigmoids(self, t: Float[Tensor, "*batch"], scale: Tensor) -> Float[Tensor, "*batch K"]:
        """σ((τ − τ_k)/w)."""
        left = torch.log(1 + (self.duration - t) / scale) / torch.log(1 + self.duration / scale)
        return torch.sigmoid((left[..., None] - self.STEPS.to(left)) / self.WIDTH)

    @torch.no_grad()
    def fit(self, nodes: Float[Tensor, " N"], values: Float[Tensor, "N *shape"]) -> None:
        """Fit the curve by least squares, in y and dy/dτ, to a cubic spline through the given points.

        It passes through the last point, at T. If a value is not finite, the curve is NaN.
        """
        if not values.isfinite().all():
            self.end.copy_(values[-1])
            self.weights.fill_(torch.nan)
            return
        from scipy.interpolate import CubicSpline  # imported here because it takes 0.3 s

        spline = CubicSpline(nodes.double().cpu(), values.double().cpu().flatten(1))
        t = _subdivide(nodes.double().cpu(), self.BETWEEN)
        y, y_t = (torch.from_numpy(spline(t, order)) for order in (0, 1))
        end, unit = y[-1], y.abs().amax(0).clamp_min(torch.finfo(y.dtype).tiny)
        best = math.inf
        for share in self.SCALES:
            scale = torch.tensor(share * self.duration, dtype=torch.float64)
            t_tau = -(self.duration - t + scale) * torch.log(1 + self.duration / scale)
            risen = self._sigmoids(t, scale)
            rows = torch.cat([self._basis(t, scale), risen * (1 - risen) / self.WIDTH])
            wanted = torch.cat([y - end, t_tau[:, None] * y_t]) / unit
            gram = rows.mT @ rows + self.RIDGE * torch.eye(rows.shape[-1]).to(rows)
            weights = torch.linalg.solve(gram, rows.mT @ wanted)
            error = float((rows @ weights - wanted).square().sum())
            if error < best:
                best = error
                self.scale.copy_(scale)
                self.weights.copy_((weights * unit).unflatten(-1, self.end.shape))
        self.end.copy_(values[-1])


def _subdivide(nodes: Tensor, parts: int) -> Tensor:
    """The nodes with each interval divided into `parts` equal parts."""
    shares = torch.arange(parts) / parts
    return torch.cat([(nodes[:-1, None] + shares * nodes.diff()[:, None]).flatten(), nodes[-1:]])


def _furthest_from(nodes: Tensor, values: Tensor, kept: list[int]) -> int:
    """The index of the point with the largest relative distance from the piecewise linear curve through some points."""
    share = _share_below(nodes, nodes[kept])
    error = (values - values[kept][0] - share @ values[kept].diff(dim=0)).abs() / (values.abs() + 1e-3)
    return int(error.amax(1).index_fill(0, torch.tensor(kept, device=error.device), -1).argmax())


def _share_below(x: Tensor, nodes: Tensor) -> Tensor:
    """The share of each interval between nodes that lies below x, (*batch, K − 1)."""
    r = (x[..., None] - nodes[:-1]) / nodes.diff()
    return torch.relu(r) - torch.relu(r - 1)  # at a node only one interval has a nonzero slope; with clamp two would


def _cardinal(nodes: Tensor, degree: int) -> Tensor:
    """(K, 1 + (K − 1)·degree): the cardinal functions of the K nodes, as coefficients of 1 and the powers of s_i."""
    unit, h = torch.eye(len(nodes), dtype=torch.float64), nodes.diff()
    if degree == 1:
        powers = [unit[:, 1:] - unit[:, :-1]]
    else:
        from scipy.interpolate import CubicSpline

        coefficients = torch.as_tensor(CubicSpline(nodes.numpy(), unit.numpy(), axis=1, bc_type="natural").c)
        powers = [coefficients[3 - k].mT * h**k for k in (1, 2, 3)]
    return torch.cat([unit[:, :1], *powers], 1)
