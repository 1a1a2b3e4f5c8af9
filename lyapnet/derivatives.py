"""First and second derivatives of steps along trajectories, also where one of them does not exist."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from lyapnet.linear_algebra import apply
from lyapnet.types import Control, ControlPath, PerState, State, StatePath

Step = Callable[[State, Control], tuple[State, PerState]]  # (x, u) ↦ (F, l)
BESIDE = 1e-3  # of the extent of trajectories: how far beside a node derivatives are taken that do not exist at it


class Steps(NamedTuple):
    """F(z), l(z) and their derivatives at z = (x, u) of all steps at once, F with its graph; and φ at the end."""

    z: Tensor
    F: StatePath
    F_z: Tensor
    paid: Tensor
    l_z: Tensor
    l_zz: Tensor  # what the second derivatives of Q have besides F_zᵀHF_z
    end: tuple[PerState, State, Tensor]  # φ, φ_x and φ_xx
    mended: Tensor  # (N + 1, *batch), where a derivative does not exist
    beside: Tensor  # (n + m,), how far beside z it is then taken


def steps_along(step: Step, terminal: Callable[[State], PerState], x: StatePath, u: ControlPath) -> Steps:
    """The derivatives along x (N + 1, b, n) under u (N, b, m), but the second ones of F.

    Those that do not exist at a node, as the second one of |v|v at rest, are the mean of those BESIDE it on either
    side, or those of the one side that has them.

    Args:
        step: (x, u) ↦ (F, l), where one step leads and what it costs.
        terminal: φ.
    """
    n, beside = x.shape[-1], _beside(x, u)

    def derivatives(z: Tensor, F: Tensor, paid: Tensor) -> list[Tensor]:
        l_z = jacobian(paid[..., None], z)[..., 0, :]
        return [jacobian(F, z), l_z, jacobian(l_z, z)]

    def at_end(x: Tensor, phi: PerState) -> list[Tensor]:
        phi_x = jacobian(phi[..., None], x)[..., 0, :]
        return [phi_x, jacobian(phi_x, x)]

    with torch.enable_grad():
        z, last = torch.cat([x[:-1], u], -1).detach().requires_grad_(), x[-1].detach().requires_grad_()
        (F, paid), phi = step(z[..., :n], z[..., n:]), terminal(last)
        (F_z, l_z, l_zz), mended = _mended(
            lambda z, _: derivatives(z, *step(z[..., :n], z[..., n:])), z, derivatives(z, F, paid), beside
        )
        (phi_x, phi_xx), end_mended = _mended(lambda x, _: at_end(x, terminal(x)), last, at_end(last, phi), beside[:n])
    end = phi.detach(), phi_x, phi_xx
    return Steps(z, F, F_z, paid.detach(), l_z, l_zz, end, torch.cat([mended, end_mended[None]]), beside)


def costates(steps: Steps) -> StatePath:
    """The slope of what controls cost from where each step lands on, (N, b, n): p_N = φ_x, p_n = l_x + F_xᵀp_{n+1}."""
    p = [steps.end[1]]
    n = p[0].shape[-1]
    for l_z, F_z in zip(steps.l_z[1:].flip(0), steps.F_z[1:].flip(0), strict=True):
        p.append(l_z[..., :n] + apply(F_z[..., :n].mT, p[-1]))
    return torch.stack(p[::-1])


def with_curvature(step: Step, steps: Steps, p: StatePath) -> Steps:
    """The same with the second derivatives of pᵀF added to l_zz: at nodes where no side has them, with none.

    Args:
        p: (N, b, n), of where each step lands.
    """
    n = p.shape[-1]

    def bends(z: Tensor, F: StatePath, p: StatePath) -> list[Tensor]:
        return [jacobian(jacobian((p * F).sum(-1, keepdim=True), z)[..., 0, :], z)]

    with torch.enable_grad():
        (bent,), missing = _mended(
            lambda z, rows: bends(z, step(z[..., :n], z[..., n:])[0], p[rows]),
            steps.z,
            bends(steps.z, steps.F, p),
            steps.beside,
        )
    mended = steps.mended | torch.cat([missing, torch.zeros_like(missing[:1])])
    return steps._replace(l_zz=steps.l_zz + bent.nan_to_num(0, 0, 0), mended=mended)


def _beside(x: StatePath, u: ControlPath) -> Tensor:
    """BESIDE of how far each component of (x, u) goes, of its size where it stays, of 1 where that is 0."""
    found = list[Tensor]()
    for path in (x.detach().flatten(0, -2), u.detach().flatten(0, -2)):
        extent, size = path.amax(0) - path.amin(0), path.abs().amax(0)
        found.append(extent.where(extent > 0, size.where(size > 0, 1)))
    return BESIDE * torch.cat(found)


def _mended(
    function: Callable[[Tensor, Tensor], list[Tensor]], z: Tensor, parts: list[Tensor], beside: Tensor
) -> tuple[list[Tensor], Tensor]:
    """Derivatives at z of all nodes, where they are not finite from beside them, and where that is so.

    Args:
        function: (z, rows) ↦ the same derivatives at other z of those nodes.
        parts: the derivatives at z.
        beside: a deviation of z, to either side.
    """
    parts = [part.detach() for part in parts]
    missing = ~torch.stack([part.flatten(z.ndim - 1).isfinite().all(-1) for part in parts]).all(0)
    if missing.any():
        sides = [function((z.detach()[missing] + side * beside).requires_grad_(), missing) for side in (1, -1)]
        for part, one, other in zip(parts, *sides, strict=True):
            both = torch.stack([one.detach(), other.detach()])
            mean = both.where(both.isfinite(), torch.nan).nanmean(0)
            part[missing] = part[missing].where(part[missing].isfinite(), mean)
    return parts, missing


def jacobian(y: Tensor, z: Tensor) -> Tensor:
    """∂y/∂z, (*batch, outputs, inputs), each state's by itself; zero where y does not depend on z."""
    if not y.requires_grad:
        return y.new_zeros(*y.shape, z.shape[-1])
    rows = [torch.autograd.grad(y_i.sum(), z, create_graph=True, materialize_grads=True)[0] for y_i in y.unbind(-1)]
    return torch.stack(rows, -2)
