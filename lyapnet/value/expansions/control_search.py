"""The minimum over controls of a function that need not be convex, such as the Hamiltonian of many systems."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from lyapnet.base.linear_algebra import apply, convex_or
from lyapnet.base.types import Control, ControlMatrix, PerState
from lyapnet.task.problem import Problem
from lyapnet.value.derivatives import jacobian

Several = Float[Tensor, "k *batch m"]  # several controls for each state
Objective = Callable[[Control], PerState]  # Q of controls (*several, *batch, m), smooth, per second
PLACES = 16  # number of values of each control at which Q is compared
GROUPS = 4  # number of groups of neighbouring values; the best of each is a start
FIRST_STEPS = 1  # number of Newton steps from each start
LAST_STEPS = 5  # number of Newton steps from the best point after these
SHARES = (3.0, 1.0, 0.3, 0.03)  # step sizes of the line search in a Newton step; the largest is for negative curvature
POLISHING_STEPS = 1  # number of last Newton steps without a line search, which the rounding of Q would end too early


def minimise_over_controls(problem: Problem, Q: Objective, starts: Several, weight: ControlMatrix) -> Control:
    """argmin over u ∈ U of Q(u) + s(u), (*batch, m), from the start that is best after FIRST_STEPS Newton steps.

    A Newton step leads towards the minimiser over U of the quadratic model of Q plus s, with a line search. An
    indefinite Q_uu is made positive definite by adding twice its absolute row sums to the diagonal, and the weight. The
    derivative is that of the minimiser (implicit function theorem).

    Args:
        problem: U, a box or all of ℝᵐ, and s.
        Q: the objective without s, (k, *batch, m) ↦ (k, *batch) for any k, and (*batch, m) ↦ (*batch).
        starts: (k, *batch, m) in U.
        weight: (*batch, m, m), symmetric positive definite, as 2R: the least curvature is CONVEX times it.

    Source: Nocedal, Wright, Numerical Optimization, 2006, ch. 3 and 16.
    """
    search = _Search(problem, Q, weight)
    with torch.no_grad():
        u = starts
        for _ in range(FIRST_STEPS if len(starts) > 1 else 0):
            u = search.descend(u)
        u = search.lowest(u)
        for _ in range(LAST_STEPS):
            u = search.descend(u)
        for _ in range(POLISHING_STEPS):
            u = search.polish(u)
    if not torch.is_grad_enabled():
        return u
    moved = search.newton(u)
    return u + (moved - moved.detach())


def starts_of(problem: Problem, Q: Objective, nominal: Control, paid: PerState, weight: ControlMatrix) -> Several:
    """Starts of a search (k, *batch, m): the nominal control, one Newton step from it, and GROUPS for each control.

    For these, PLACES values between the limits of one control are compared, with the others at their nominal values.
    Without a limit the distance of the values from the nominal one is at most the length of the Newton step plus the
    size of a control that costs ℓ.

    Args:
        paid: ℓ at the nominal control, per second.
    """
    m = nominal.shape[-1]
    with torch.no_grad():
        search = _Search(problem, Q, weight)
        guess = search.newton(nominal)
        size = torch.sqrt(2 * paid.abs()[..., None] / weight.diagonal(dim1=-2, dim2=-1))
        reach = (guess - nominal).abs() + size
        low, high = nominal - reach, nominal + reach
        if problem.controls.limits is not None:
            lower, upper = (side.to(nominal).expand(m) for side in problem.controls.limits)
            low, high = torch.where(lower.isfinite(), lower, low), torch.where(upper.isfinite(), upper, high)
        found = [nominal, problem.controls.project(guess)]
        for i in range(m):
            this = torch.arange(m, device=nominal.device) == i
            shares = [(k + 0.5) / PLACES for k in range(PLACES)]
            places = torch.stack([torch.where(this, low + share * (high - low), nominal) for share in shares])
            found += [search.lowest(group) for group in problem.controls.project(places).chunk(GROUPS)]
        return torch.stack(found)


class _Search:
    """Newton steps towards a minimum of Q + s over U."""

    def __init__(self, problem: Problem, Q: Objective, weight: ControlMatrix):
        self.problem, self.Q, self.weight = problem, Q, weight.detach()

    def descend(self, u: Control) -> Control:
        """The best of u and of the points of a line search along the Newton step."""
        direction = self.newton(u) - u
        return self.lowest(torch.stack([u, *(self.problem.controls.project(u + s * direction) for s in SHARES)]))

    def polish(self, u: Control) -> Control:
        """The Newton step, unless Q rises by more than its rounding."""
        moved = self.problem.controls.project(self.newton(u))
        before, after = self.total(torch.stack([u, moved]))
        rounding = torch.finfo(u.dtype).eps ** 0.5 * before.abs()
        return torch.where((after <= before + rounding)[..., None], moved, u)

    def lowest(self, u: Several) -> Control:
        """The control of least Q + s, of (k, *batch, m)."""
        total = self.total(u)
        best, least = u[0], total[0]
        for control, value in zip(u[1:], total[1:], strict=True):
            best, least = torch.where((value < least)[..., None], control, best), torch.minimum(value, least)
        return best

    def total(self, u: Control) -> PerState:
        """Q + s; infinite where it is not finite."""
        total = self.Q(u) + self.problem.cost.beside(u)
        return torch.where(total.isfinite(), total, torch.inf)

    def newton(self, u: Control) -> Control:
        """The minimiser over U of s plus the quadratic model of Q around u, whose Q_uu counts as a constant."""
        slope, curvature = derivatives_of(self.Q, u)
        W = self._convex(curvature, u.detach(), slope.detach())
        return self.problem.best_control(W / 2, slope - apply(W, u.detach()))

    def _convex(self, curvature: Tensor, u: Control, slope: Control) -> Tensor:
        """Q_uu, or a positive definite matrix if it is indefinite.

        A control whose slope holds it at a limit does not move; only Q_uu of the others has to be positive definite.
        """
        falling = torch.where(slope > 0, u - 1, u + 1)
        moves = (self.problem.controls.project(falling) != u).to(u)
        both = moves[..., :, None] * moves[..., None, :]
        held = torch.diag_embed((1 - moves) * self.weight.diagonal(dim1=-2, dim2=-1))
        curvature, weight = both * curvature + held, both * self.weight + held
        rows = torch.diag_embed(2 * curvature.abs().sum(-1))
        return convex_or(curvature, weight, curvature + rows + weight)


def derivatives_of(Q: Objective, u: Control) -> tuple[Control, ControlMatrix]:
    """(Q_u, Q_uu) at u; autograd can differentiate Q_u by the other tensors that Q depends on."""
    recording = torch.is_grad_enabled()
    with torch.enable_grad():
        u = u.detach().requires_grad_()
        value = Q(u)
        slope = torch.autograd.grad(value.sum(), u, create_graph=True, materialize_grads=True)[0]
        if not slope.requires_grad:  # Q is linear in u
            return slope, slope.new_zeros(*u.shape, u.shape[-1])
        curvature = jacobian(slope, u).detach()
    return slope if recording else slope.detach(), (curvature + curvature.mT) / 2
