"""First and second derivatives of steps along trajectories, with replacements where one does not exist."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from lyapnet.base.linear_algebra import apply
from lyapnet.base.types import Control, ControlPath, PerState, State, StatePath

Step = Callable[[State, Control], tuple[State, PerState]]  # (x, u) ↦ (F, l)
STEP_ASIDE = 1e-3  # distance from a node at which a missing derivative is evaluated, relative to the extent of paths


class StepDerivatives:
    """First and second derivatives of a step's next state and cost in z = (x, u), by torch, for many z at once.

    For a Jacobian z is copied once for each output, so that one backward pass computes all rows.

    Args:
        step: (x, u) ↦ (F, l), the next state and the cost of a step.
        n: number of states.
    """

    def __init__(self, step: Step, n: int):
        self.step, self.n = step, n

    def first(self, z: Tensor) -> list[Tensor]:
        """[F, l, F_z, l_z, l_zz] at z (r, n + m)."""
        with torch.enable_grad():
            z = z.detach().requires_grad_()
            F, paid = self._at(z)
            (l_z,) = torch.autograd.grad(paid.sum(), z, materialize_grads=True)
            F_z = jacobian_of(lambda z: self._at(z)[0], z, self.n)
            l_zz = jacobian_of(lambda z: _slope(self._at(z)[1], z), z, z.shape[-1])
        return [F.detach(), paid.detach(), F_z, l_z, l_zz]

    def curvature(self, z: Tensor, p: State) -> Tensor:
        """The second derivatives of pᵀF at z (r, n + m), for p (r, n)."""
        with torch.enable_grad():
            return jacobian_of(lambda z: _slope((p * self._at(z)[0]).sum(-1), z), z, z.shape[-1])

    def _at(self, z: Tensor) -> tuple[State, PerState]:
        return self.step(z[..., : self.n], z[..., self.n :])


@torch.enable_grad()
def jacobian_of(function: Callable[[Tensor], Tensor], z: Tensor, outputs: int) -> Tensor:
    """∂y/∂z (*batch, outputs, inputs) of y = function(z) at z (*batch, inputs); row i is that of copy i of z."""
    copies = z.detach().expand(outputs, *z.shape).clone().requires_grad_()
    y = function(copies)
    if not y.requires_grad:
        return z.new_zeros(*z.shape[:-1], outputs, z.shape[-1])
    rows = torch.eye(outputs).to(y).reshape(outputs, *[1] * (y.ndim - 2), outputs).expand_as(y)
    return torch.autograd.grad(y, copies, rows, materialize_grads=True)[0].movedim(0, -2)


def _slope(y: PerState, z: Tensor) -> Tensor:
    if not y.requires_grad:
        return torch.zeros_like(z)
    return torch.autograd.grad(y.sum(), z, create_graph=True, materialize_grads=True)[0]


class Steps(NamedTuple):
    """F(z), l(z) and their derivatives at z = (x, u) of all steps at once; and φ at the end."""

    z: Tensor
    F: StatePath
    F_z: Tensor
    paid: Tensor
    l_z: Tensor
    l_zz: Tensor  # second derivatives of Q besides F_zᵀHF_z
    end: tuple[PerState, State, Tensor]  # φ, φ_x and φ_xx
    replaced: Tensor  # (N + 1, *batch), whether a derivative does not exist at a node
    beside: Tensor  # (n + m,), the distance from z at which it is then evaluated


def steps_along(
    derivatives: StepDerivatives, terminal: Callable[[State], PerState], x: StatePath, u: ControlPath
) -> Steps:
    """The derivatives along x (N + 1, b, n) under u (N, b, m), except the second derivatives of F.

    A derivative that does not exist at a node, such as the second one of |v|v at rest, is replaced by the mean of those
    on both sides of the node, or by that of the one side where it exists.

    Args:
        terminal: φ.
    """
    n, beside = x.shape[-1], _steps_aside(x, u)
    z = torch.cat([x[:-1], u], -1).detach()

    def at_end(x: Tensor) -> list[Tensor]:
        with torch.enable_grad():
            x = x.detach().requires_grad_()
            phi = terminal(x)
            phi_x = jacobian(phi[..., None], x)[..., 0, :]
            return [phi.detach(), phi_x.detach(), jacobian(phi_x, x).detach()]

    values = [part.unflatten(0, z.shape[:-1]) for part in derivatives.first(z.flatten(0, -2))]
    (F, paid), (slopes, replaced) = (
        values[:2],
        _replace_missing(lambda z, _: derivatives.first(z)[2:], z, values[2:], beside),
    )
    phi, *bends = at_end(x[-1])
    (phi_x, phi_xx), end_mended = _replace_missing(lambda x, _: at_end(x)[1:], x[-1], bends, beside[:n])
    F_z, l_z, l_zz = slopes
    end, replaced = (phi, phi_x, phi_xx), torch.cat([replaced, end_mended[None]])
    return Steps(z, F, F_z, paid, l_z, l_zz, end, replaced, beside)


def costates(steps: Steps) -> StatePath:
    """The costates p_1 … p_N (N, b, n), the gradient of the cost to go: p_N = φ_x, p_n = l_x + F_xᵀp_{n+1}."""
    p = [steps.end[1]]
    n = p[0].shape[-1]
    for l_z, F_z in zip(steps.l_z[1:].flip(0), steps.F_z[1:].flip(0), strict=True):
        p.append(l_z[..., :n] + apply(F_z[..., :n].mT, p[-1]))
    return torch.stack(p[::-1])


def with_curvature(derivatives: StepDerivatives, steps: Steps, p: StatePath) -> Steps:
    """Add the second derivatives of pᵀF to l_zz; zero at nodes where they exist on neither side.

    Args:
        p: the costates (N, b, n) at the end of each step.
    """
    z = steps.z
    bends = derivatives.curvature(z.flatten(0, -2), p.flatten(0, -2)).unflatten(0, z.shape[:-1])
    (bent,), missing = _replace_missing(lambda z, rows: [derivatives.curvature(z, p[rows])], z, [bends], steps.beside)
    replaced = steps.replaced | torch.cat([missing, torch.zeros_like(missing[:1])])
    return steps._replace(l_zz=steps.l_zz + bent.nan_to_num(0, 0, 0), replaced=replaced)


def _steps_aside(x: StatePath, u: ControlPath) -> Tensor:
    """STEP_ASIDE times the range of each component of (x, u), or its size if it is constant, or 1 if that is 0."""
    found = list[Tensor]()
    for path in (x.detach().flatten(0, -2), u.detach().flatten(0, -2)):
        extent, size = path.amax(0) - path.amin(0), path.abs().amax(0)
        found.append(extent.where(extent > 0, size.where(size > 0, 1)))
    return STEP_ASIDE * torch.cat(found)


def _replace_missing(
    function: Callable[[Tensor, Tensor], list[Tensor]], z: Tensor, parts: list[Tensor], beside: Tensor
) -> tuple[list[Tensor], Tensor]:
    """Replace non-finite derivatives by those beside the nodes; returns also which nodes these are.

    Args:
        function: (z, rows) ↦ the derivatives at other z for some nodes.
        parts: the derivatives at z.
        beside: the deviation of z to either side.
    """
    missing = ~torch.stack([part.flatten(z.ndim - 1).isfinite().all(-1) for part in parts]).all(0)
    if missing.any():
        sides = [function(z[missing] + side * beside, missing) for side in (1, -1)]
        for part, one, other in zip(parts, *sides, strict=True):
            both = torch.stack([one, other])
            mean = both.where(both.isfinite(), torch.nan).nanmean(0)
            part[missing] = part[missing].where(part[missing].isfinite(), mean)
    return parts, missing


def jacobian(y: Tensor, z: Tensor) -> Tensor:
    """∂y/∂z of each state, (*batch, outputs, inputs); zero if y does not depend on z."""
    if not y.requires_grad:
        return y.new_zeros(*y.shape, z.shape[-1])
    rows = [torch.autograd.grad(y_i.sum(), z, create_graph=True, materialize_grads=True)[0] for y_i in y.unbind(-1)]
    return torch.stack(rows, -2)
