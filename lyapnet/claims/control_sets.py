"""Checks of u(t, x) before a proof: u ∈ U for a user's control set, and u as the minimiser of its cost."""

import logging
import operator
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn
from torch.fx import GraphModule
from torch.fx.node import map_arg

from lyapnet.base.contracts import reaches_own_code
from lyapnet.base.errors import LyapnetError, UsageError
from lyapnet.base.types import Corner
from lyapnet.graphs.tracing import name_of, trace
from lyapnet.loop.rollout.closed_loop import ClosedLoop
from lyapnet.prover.bounds import BoundedFunction
from lyapnet.prover.boxes import Boxes, random_points, root_boxes
from lyapnet.prover.branch_and_bound import Budget, Question, choose_axis, run_search
from lyapnet.prover.minima import BACKWARD, is_minimum
from lyapnet.prover.taylor import interval_form
from lyapnet.task.ball import ControlBall
from lyapnet.task.cost.control_costs import CONTROL_COSTS, AbsoluteCost, PowerCost
from lyapnet.task.cost.minimum import description, is_quadratic_between_limits
from lyapnet.task.sets import about_control
from lyapnet.value.policy import HJBPolicy, SampledPolicy, ValuePolicy

POINTS, DESCENTS = 20_000, 20  # number of points at which u ∈ U is tested, and of descent steps from the worst of them
STARTS = 256  # number of these worst points
MINIMA = 5000  # number of points at which u is tested as a minimiser
ROUNDING = 1e-6  # largest distance of u from U that counts as rounding, relative to the largest |u|
BOXES, SECONDS = 2000, 20.0  # limits of the proof that u ∈ U
ASSUMED = "That u stays in U was tested at {} points of [0, T] × D, and is not proved: bounds cannot decide it for {}."

MINIMISED = (
    "That the computed u is the minimiser, up to {:g} of the slopes that balance there, was tested at {} points of "
    "[0, T] × D, and is not proved."
)


def check_controls(loop: ClosedLoop, domain: tuple[Corner, Corner]) -> str:
    """Refuse a law that leaves a user's control set U somewhere in a box of (t, x).

    The comparisons in `contains` are tested at random points and along gradient descents from the worst of them, and
    bounded on boxes. Bounds may decide nothing, for example if u reaches the boundary of a disk.

    Returns:
        A sentence for the claim that says what is assumed of u; empty if u ∈ U is proved, or U is one of lyapnet's.

    Raises:
        UsageError: u leaves U; or `contains` cannot be traced.
    """
    policy = loop.policy
    if not isinstance(policy, ValuePolicy) or not policy.controls.limited or not reaches_own_code(policy.controls):
        return ""
    name, (lower, upper) = type(policy.controls).__name__, domain
    points = random_points(*domain, POINTS, torch.Generator().manual_seed(2))
    with torch.no_grad():
        u = policy(points[:, 0], points[:, 1:])
        room = ROUNDING * float(u.abs().max())
        # u may lie outside by rounding: it passes if U contains u shifted by `room` in one of these directions
        axes = torch.eye(u.shape[-1]).to(u)
        shifts = torch.cat([axes, -axes, axes.new_tensor([[1.0], [-1.0]]).expand(2, len(axes)), 0 * axes[:1]])
        outside = points[~policy.controls.contains(u[:, None] + room * shifts).any(-1)]
    margin, proved = _margin(policy), False
    if margin is not None and not len(outside):
        try:
            question = _Inside(margin, BoundedFunction(lambda t, x: tuple(margin(t, x)), (lower, upper)), room)
        except LyapnetError:  # an operator of `contains` without a rule
            question = _Inside(margin, None, room)
        else:
            budget = Budget(SECONDS, boxes=BOXES)
            proved = not len(run_search(question, root_boxes(lower[None], upper[None]), budget).frontier.key)
        question.look(_descend(margin, points, lower, upper))
        outside, proved = question.outside, proved and not len(question.outside)
    if len(outside):
        with torch.no_grad():
            u = policy(outside[0, 0], outside[0, 1:])
        raise UsageError(
            f"Expected {name}.minimise(R, b) in the set that contains(u) describes, got u = {u.tolist()} outside of it "
            f"at (t, x) = {[round(y, 6) for y in outside[0].tolist()]}; correct one of the two."
        )
    if proved:
        return ""
    assumed = ASSUMED.format(POINTS, name)
    logging.getLogger(__name__).warning("note: %s", assumed)
    return assumed


def require_written_law(loop: ClosedLoop, claim: str) -> None:
    """Refuse a law whose u is no closed form (see `reads_as_written`), for a claim that bounds the operations of u.

    Args:
        claim: the kind of the certificate, for the message.

    Raises:
        UsageError: the message names the costs and the set.
    """
    policy = loop.policy
    if not isinstance(policy, ValuePolicy) or reads_as_written(policy):
        return
    raise UsageError(
        f"Expected controls that cost uᵀRu, without limits or between them, for a {claim} certificate, got "
        f"{_in_words(policy)}; a statistical certificate takes them, a sound one those that it knows."
    )


def reads_as_written(policy: ValuePolicy) -> bool:
    """Whether the code of u is a closed form: for the cost uᵀRu between limits, or one control with a cost |u|."""
    if is_quadratic_between_limits(policy.cost.nonquadratic, policy.controls):
        return True
    return policy.system.m == 1 and _pays_absolute_values(policy) and not isinstance(policy.controls, ControlBall)


def require_known_minimum(loop: ClosedLoop, claim: str) -> None:
    """Refuse a law whose u is neither a closed form nor a minimiser that lyapnet.prover.minima can bound.

    Raises:
        UsageError: the message names the costs and the set, and the law.
    """
    policy = loop.policy
    if not isinstance(policy, ValuePolicy) or is_quadratic_between_limits(policy.cost.nonquadratic, policy.controls):
        return
    names, cost = _in_words(policy), policy.cost
    if description(cost.nonquadratic, policy.controls) is None:
        raise UsageError(
            f"Expected costs of controls of lyapnet's own ({', '.join(CONTROL_COSTS)}) between limits or in a ball for "
            f"a {claim} certificate, got {names}; take one of them, or a statistical certificate."
        )
    if any(isinstance(each, PowerCost) and each.exponent < 2 for each in _costs_of_controls(policy)):
        # near u = 0, where their curvature has no bound, Newton's method ends 5e-9 from the minimiser, not 1e-10
        raise UsageError(
            f"Expected powers of at least 2 as costs of controls for a {claim} certificate, got less in {names}; take "
            "pseudo_huber, which is smooth, or a statistical certificate."
        )
    if type(policy) is HJBPolicy and not cost.has_methods_of_its_own:
        return
    if type(policy) is not SampledPolicy or not _pays_absolute_values(policy) or cost.has_methods_of_its_own:
        raise UsageError(
            f"Expected the law of rollout.policy=hjb, and a cost whose methods are those of ℓ = q + uᵀRu + s(u), for a "
            f"{claim} certificate with {names}, got {type(policy).__name__} and {type(cost).__name__}; train with "
            "rollout.policy=hjb, or take a statistical certificate."
        )


def _pays_absolute_values(policy: ValuePolicy) -> bool:
    """Whether all costs of controls beside uᵀRu are absolute values w|u|."""
    return all(type(cost) is AbsoluteCost for cost in _costs_of_controls(policy))


def _costs_of_controls(policy: ValuePolicy) -> list[nn.Module]:
    """The costs of the controls beside uᵀRu."""
    costs = policy.cost.nonquadratic
    return [] if costs is None else [*costs.costs]


def _in_words(policy: ValuePolicy) -> str:
    """The costs of the controls and their set, as in "AbsoluteCost in ControlBox"."""
    names = [type(cost).__name__ for cost in _costs_of_controls(policy)]
    return f"{' and '.join(names) or 'uᵀRu'} in {type(policy.controls).__name__}"


def check_minimum(loop: ClosedLoop, domain: tuple[Corner, Corner]) -> str:
    """Test at random points of a box of (t, x) that u is the minimiser that bounds take it for.

    Returns:
        A sentence for the claim that says what is assumed of u; empty if u is a closed form.

    Raises:
        UsageError: at a point u is farther from the minimiser than bounds allow for.
    """
    policy, points = loop.policy, random_points(*domain, MINIMA, torch.Generator().manual_seed(2))
    if not isinstance(policy, ValuePolicy):
        return ""
    with torch.no_grad():
        least = policy.least(points[:, 0], points[:, 1:])
        if least is None:
            return ""
        R, rest = policy.cost.R(points[:, 1:]), policy.cost.rest_at(points[:, 1:])
        b = about_control(R, least.b, rest)
        right = is_minimum(policy.cost.nonquadratic, policy.controls, R, b, least.u)
    if not bool(right.all()):
        k = int(right.to(torch.uint8).argmin())
        raise UsageError(
            f"Expected u that minimises ℓ + V_xᵀ(f + gu) up to {BACKWARD:g}, got u = {least.u[k].tolist()} at (t, x) = "
            f"{points[k].tolist()}, where Newton's method has not converged; give controls a larger R."
        )
    return MINIMISED.format(BACKWARD, MINIMA)


@dataclass
class _Inside(Question):
    """Whether margins are at least −room on boxes; each is bounded by a Taylor form and by an interval.

    Intervals are exact at the limits of a clamped control.
    """

    margin: Callable[[Tensor, Tensor], Tensor]  # (t, x) ↦ margins
    bounded: BoundedFunction | None  # of the margins
    room: float
    outside: Tensor = field(default_factory=lambda: torch.zeros(0, 0))  # one (t, x) with a smaller margin, or none

    @property
    def is_settled(self) -> bool:
        return len(self.outside) > 0

    def find_undecided(self, boxes: Boxes) -> tuple[Boxes, Tensor]:
        assert self.bounded is not None
        forms = self.bounded.forms(boxes.lower, boxes.upper)
        plain = self.bounded.image(interval_form(boxes.lower, boxes.upper))
        low = torch.stack([torch.maximum(f.interval()[0], p.interval()[0]) for f, p in zip(forms, plain, strict=True)])
        boxes, worst = boxes._replace(key=low.amin(0)), int(low.amin(1).argmin())
        chosen = ~(boxes.key >= -self.room)
        self.look(boxes.center[chosen])
        return boxes[chosen], choose_axis(self.bounded, forms[worst], boxes, chosen, worst)

    def look(self, points: Tensor) -> None:
        """Look for a point at which a margin is too small, and keep the first one."""
        if len(points) and not self.is_settled:
            with torch.no_grad():
                self.outside = points[(self.margin(points[:, 0], points[:, 1:]) < -self.room).any(-1)][:1]


def _margin(policy: ValuePolicy) -> Callable[[Tensor, Tensor], Tensor] | None:
    """(t, x) ↦ the margins, (*batch, comparisons), of the comparisons in contains(u(t, x)); all are ≥ 0 if u ∈ U.

    None if `contains` is not a conjunction of comparisons.
    """
    like = torch.zeros(policy.system.m, dtype=torch.float64)
    try:
        graph = trace(lambda u: (policy.controls.contains(u),), [like])
    except Exception as error:  # user code may raise anything
        raise UsageError(
            f"Expected {type(policy.controls).__name__}.contains(u) that torch can trace, got {error}; write it in "
            "torch operations."
        ) from error
    try:
        _margins_of(graph, like)
    except NotImplementedError:
        return None

    def margin(t: Tensor, x: Tensor) -> Tensor:
        u = policy(t, x)
        return torch.func.vmap(lambda v: _margins_of(graph, v))(u) if u.ndim > 1 else _margins_of(graph, u)

    return margin


def _margins_of(graph: GraphModule, u: Tensor) -> Tensor:
    """Run a graph with a margin instead of the truth value of each comparison, which is false where the margin is < 0.

    The margins of a conjunction form a vector, since bounds of their minimum would be less tight.

    Raises:
        NotImplementedError: the graph uses a truth value in another way.
    """
    values, truths, joined = dict[Any, Any](), set[Any](), set[Any]()
    for node in graph.graph.nodes:
        if node.op == "placeholder":
            values[node] = u
        elif node.op == "get_attr":
            values[node] = operator.attrgetter(str(node.target))(graph).detach()
        elif node.op == "output":
            return values[node.args[0][0]].reshape(-1)  # pyright: ignore[reportArgumentType, reportIndexIssue]
        else:
            arguments, keywords = (map_arg(each, values.__getitem__) for each in (node.args, node.kwargs))
            name, sources = name_of(node.target), node.all_input_nodes
            is_truth, of_truths = node.meta["val"].dtype == torch.bool, not truths.isdisjoint(sources)
            if name in ("all", "bitwise_and", "logical_and", "mul") and is_truth:
                if not truths.issuperset(sources):
                    raise NotImplementedError(str(node.target))
                values[node] = torch.cat([values[source].reshape(-1) for source in sources])
                joined.add(node)
            elif name == "eq" and node.args[0] is node.args[1]:  # isfinite compares a number with itself
                values[node] = _finite(arguments[0])
            elif is_truth and name in MARGINS and joined.isdisjoint(sources):
                values[node] = MARGINS[name](*arguments, **keywords)
            elif is_truth or of_truths:
                raise NotImplementedError(str(node.target))
            else:
                values[node] = node.target(*arguments, **keywords)
            truths.update([node] * is_truth)
    raise AssertionError("a graph ends with its output")


def _unequal(a: Tensor, b: Any) -> Tensor:
    if b in (torch.inf, -torch.inf):
        return _finite(a)
    raise NotImplementedError("ne")  # a ≠ b has no margin


def _finite(value: Tensor) -> Tensor:
    return 1 + 0 * value  # a value with bounds is finite


# operator with a boolean result ↦ its margin; operators that rearrange booleans rearrange their margins
MARGINS: dict[str, Callable[..., Tensor]] = {
    "le": lambda a, b: b - a, "lt": lambda a, b: b - a, "ge": lambda a, b: a - b, "gt": lambda a, b: a - b,
    "eq": lambda a, b: -(a - b).abs(), "ne": _unequal, "isfinite": _finite,
    "bitwise_or": torch.maximum, "logical_or": torch.maximum, "bitwise_not": torch.neg, "logical_not": torch.neg,
} | {
    name: getattr(torch.ops.aten, name) for name in ("select", "slice", "view", "unsqueeze", "squeeze", "stack", "cat")
}  # fmt: skip


def _descend(margin: Callable[[Tensor, Tensor], Tensor], points: Tensor, lower: Corner, upper: Corner) -> Tensor:
    """The ends of gradient descents of the least margin, from the points where it is smallest."""
    with torch.no_grad():
        least = margin(points[:, 0], points[:, 1:]).amin(-1).argsort()[:STARTS]
    at, width = points[least], upper - lower
    for k in range(DESCENTS):
        leaf = at.clone().requires_grad_()
        with torch.enable_grad():
            (slope,) = torch.autograd.grad(margin(leaf[:, 0], leaf[:, 1:]).amin(-1).sum(), leaf, materialize_grads=True)
        step = width * 0.1 / (k + 1) * (slope * width).sign()
        at = torch.minimum(torch.maximum(at - step, lower), upper)
    return at
