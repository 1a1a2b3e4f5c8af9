"""Certificates of a region of attraction of the receding law, by proof."""

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor
from torchdiffeq import odeint

from lyapnet.base.contracts import copied
from lyapnet.base.random_streams import CERTIFICATION, stream
from lyapnet.base.types import Corner
from lyapnet.claims import figures
from lyapnet.claims.certificates import (
    FROZEN,
    NOT_PROVED,
    Certificate,
    disturbance_text,
    format_state,
    named_disturbance,
)
from lyapnet.claims.held_laws import READINGS, control_of, readings_facts, readings_text
from lyapnet.claims.preconditions import over_time
from lyapnet.claims.receding_decrease import RecedingDecrease
from lyapnet.claims.region import ProvedRegion
from lyapnet.claims.stepped_decrease import SteppedDecrease
from lyapnet.claims.tables import floored
from lyapnet.loop.rollout.closed_loop import ClosedLoop
from lyapnet.prover.condition import DecreaseCondition
from lyapnet.task.sets import Box
from lyapnet.value.policy import ValuePolicy

NEAR_BOUNDARY = 0.999  # ρ relative to the least V on the boundary of D, above which only a larger D could help
PATHS, PATH_MARGIN = 16, 0.03  # number of drawn closed loops; they begin where 1 − PATH_MARGIN < V/ρ ≤ 1


class RegionCertificate(Certificate):
    """A set that no closed loop of the receding law leaves, and from which all converge to one equilibrium.

    With a disturbance, if u is held, and for a practical claim, all closed loops enter a smaller set around the goal,
    which none leaves.
    """

    kind: str = "region"
    picture: str = "region.png"
    labels: ClassVar[Mapping[str, str]] = {
        "reason": "why",
        "set": "D",
        "states_left_out": "states that nothing depends on",
        "region_volume_proved": "volume of the region, at least",
        "set_volume_share": "share of D in the region, at least",
        "volume_share": "share of X₀ in the region, at least",
        "rho_wanted": "ρ for all of X₀",
        "rho": "largest ρ proved",
        "rim": "V(0, ·) on the boundary of D and of constraints, at least",
        "steps": "about steps of",
        "decay": "λ, 1/s",
        "parameters": "parameters of the plant, constant, anywhere in",
        "nominal_parameters": "those that V and u were made for",
        "disturbance": "disturbances, at most",
        **READINGS,
        "ultimate_level": "c, V(0, ·) from some time on, at most",
        "ultimate_volume": "volume of {V(0, ·) ≤ c}, at most",
        "ultimate_extent": "box around {V(0, ·) ≤ c}",
        "entered_within": "seconds to {V(0, ·) ≤ c}, at most",
        "hole": "c, below which contraction is used",
        "contraction_box": "B",
        "contraction_rate": "κ, 1/s",
        "equilibrium_offset": "distance of the equilibrium from the goal, at most",
        "precision": "u is computed in",
        "distance_left": "distance from the goal as t → ∞, due to rounding, at most",
        "constraints": "constraints that no closed loop of the region violates",
        "counterexample": "counterexample of lowest V",
        "remaining_volume": "share of D undecided",
        "boxes": "boxes",
        "seconds": "seconds",
        "fingerprint": "fingerprint of what was bounded",
        "origin": "V and u",
    }
    claim: ProvedRegion

    @property
    def is_complete(self) -> bool:
        """Whether no larger region is needed or possible in D: it contains X₀, or almost reaches the boundary of D."""
        claim = self.claim
        highest = claim.proof.wanted if claim.steps is not None and claim.proof is not None else claim.rim
        return self.verdict == "certified" or claim.rho >= NEAR_BOUNDARY * highest

    def searched_condition(self) -> tuple[DecreaseCondition, tuple[Corner, Corner], float]:
        """The condition in plain arithmetic, {0} × D, and the level up to which it was to be proved."""
        claim = self.claim
        loop, states, w, readings = self._loop, claim.states, claim.disturbance, claim.readings
        if claim.plants is not None:
            states, w = claim.plants.around(states), None if w is None else claim.plants.disturbance_of_all(w)
            readings = readings and claim.plants.readings_of_all(readings)
        if claim.steps is not None:
            return *self._stepped(states), math.inf if claim.proof is None else claim.proof.wanted
        condition = RecedingDecrease(loop, claim.decay, w, readings=readings, practical=claim.is_practical)
        self._open_hole(condition)
        return condition, over_time(states, 0.0), claim.rim

    def _open_hole(self, condition: RecedingDecrease) -> None:
        """Exclude the hole of the claim from a condition."""
        if (claim := self.claim).hole > 0:
            condition.hole = claim.hole
            condition.constraints = condition.outside_hole(claim.contraction and claim.contraction.box)

    def _stepped(self, states: Box) -> tuple[SteppedDecrease, tuple[Corner, Corner]]:
        """The condition of steps, and {0} × D."""
        problem, claim = copied(self.controller.problem), self.claim
        if claim.plants is not None:
            problem = claim.plants.problem(problem)
        condition = SteppedDecrease(self._loop, claim.decay, problem, practical=claim.is_practical)
        condition.keep_within(states, [i for i in range(claim.states.dimension) if i not in claim.left_out])
        self._open_hole(condition)
        return condition, over_time(states, 0.0)

    @property
    def _loop(self) -> ClosedLoop:
        """The closed loop in float64; for several plants, their joint closed loop."""
        own, plants = copied(self.controller.closed_loop), self.claim.plants
        return own if plants is None else plants.all_of(own, copied(self.controller.problem))[0]

    def numbers(self) -> dict[str, Any]:
        claim, names, found = self.claim, self.controller.system.state_names, self.claim.counterexample
        proved, B, proof = claim.rho > -float("inf"), claim.contraction, claim.proof
        contraction = {} if B is None else {
            "hole": claim.hole, "contraction_box": [B.box.lower.tolist(), B.box.upper.tolist()],
            "contraction_rate": B.rate, "equilibrium_offset": B.offset,
            "contraction_coordinates": B.coordinates.tolist(), "contraction_fingerprint": B.fingerprint,
        }  # fmt: skip
        plants = claim.plants
        further = {} if claim.disturbance is None else {"disturbance": self.disturbance}
        further |= readings_facts(claim.readings, self.controller.system)
        if plants is not None:
            further |= {"parameters": plants.ranges, "nominal_parameters": dict(plants.nominal)}
        if claim.extent is not None:
            further |= {
                "ultimate_level": claim.hole, "ultimate_volume": claim.ultimate_volume,
                "entered_within": claim.entered_within,
                "ultimate_extent": [claim.extent.lower.tolist(), claim.extent.upper.tolist()],
            }  # fmt: skip
        if claim.precision is not None:
            contraction |= {"precision": claim.precision}
            contraction |= {} if math.isnan(claim.distance_left) else {"distance_left": claim.distance_left}
        search = {} if proof is None else {
            "remaining_volume": proof.remaining_volume, "boxes": proof.boxes, "fingerprint": proof.fingerprint,
        }  # fmt: skip
        return {
            "decay": claim.decay, "rho": claim.rho if proved else None, "rho_wanted": claim.wanted,
            "rim": claim.rim if claim.rim < math.inf else None,
            **({} if claim.steps is None else {"steps": f"{claim.steps.dt!r} s, {claim.steps.method}"}),
            "set": [claim.states.lower.tolist(), claim.states.upper.tolist()],
            "states_left_out": [names[i] for i in claim.left_out], "volume_share": claim.volume_share,
            "set_volume_share": claim.region_share, "region_volume_proved": claim.volume, "reason": claim.reason,
            "constraints": list(claim.constraints) if proved else [],
            "counterexample": found and {
                "x": found.x, **claim.failing_plant, "condition": found.condition, "V": found.height,
                **({} if claim.readings is None else {"after": found.after}),
            },
            "seconds": claim.seconds, **contraction, **further, **search,
            **({"origin": self._origin} if self._origin else {}),
        }  # fmt: skip

    def in_words(self) -> str:
        claim = self.claim
        if claim.rho == -float("inf"):
            return NOT_PROVED
        names = self.controller.system.state_names
        left_out = ", ".join(names[i] for i in claim.left_out)
        kept = f" or violates a constraint ({'; '.join(claim.constraints)})" if claim.constraints else ""
        origin = f" {self._origin}" * bool(self._origin)
        return (
            f"{{x ∈ D: V(0, x) ≤ ρ}} with ρ = {claim.rho!r} {self._end_of_loops(kept)}{self._nominal_text} The "
            f"volume of the region is at least {claim.volume:.6g}, in the units of the states; it holds at "
            f"least {floored(claim.volume_share)} of X₀."
            f"{f' It does not bound these states: {left_out}.' if left_out else ''}{origin} "
            f"It is about the traced operations of f, g, V and u in float64, which have these fingerprints; {FROZEN}"
        )

    def _end_of_loops(self, kept: str) -> str:
        """What is proved of closed loops in the region.

        Args:
            kept: the words on constraints.
        """
        claim, B = self.claim, self.claim.contraction
        plants, equilibrium, of_all = "for this model", "one equilibrium exponentially,", ""
        if claim.plants is not None:
            ends = ", ".join(f"{name} ∈ [{low!r}, {high!r}]" for name, (low, high) in claim.plants.ranges.items())
            of_all = f" for each of its plants with constant {ends}"
            plants = f"for each plant of this model with constant {ends}"
            equilibrium = "one equilibrium of their plant exponentially,"
        if B is not None:
            end = f"all converge to {equilibrium} which is within {B.offset:.3g} of the goal (in the norm of x)"
            if claim.precision is not None:
                end = (
                    f"all converge exponentially to within {claim.distance_left:.3g} of the goal (in the norm of x) as "
                    f"t → ∞, for every rounding of the operations of u in {claim.precision}"
                )
            if claim.steps is not None:
                return (
                    f"is a region of attraction of the receding law u(0, x) in discrete time, {self._about_steps}"
                    f"{of_all}, and not about the plant between them: no sequence of steps that starts in it leaves it"
                    f"{kept}, and {end}."
                )
            return (
                f"is a region of attraction of the receding law u(0, x), proved in continuous time {plants} with u "
                f"read at every t: no closed loop that starts in it leaves it{kept}, and {end}."
            )
        assert claim.extent is not None
        names, system = self.controller.system.state_names, self.controller.system
        under = f", {disturbance_text(self.disturbance)}" if self.disturbance else ""
        lower, upper = (side.tolist() for side in (claim.extent.lower, claim.extent.upper))
        seen = [i for i in range(len(names)) if i not in claim.left_out]
        within = ", ".join(f"{names[i]} ∈ [{lower[i]!r}, {upper[i]!r}]" for i in seen)
        how = f"proved in continuous time {plants}{under}, {readings_text(claim.readings, system)}: no closed loop"
        if claim.steps is not None:
            how = (
                f"in discrete time, {self._about_steps}{of_all}, and not about the plant between them: no sequence of "
                "steps"
            )
        return (
            f"is invariant under the receding law u(0, x), {how} that starts in it leaves it{kept}, and "
            f"each enters {{x ∈ D: V(0, x) ≤ c}}, c = "
            f"{claim.hole!r}, within {claim.entered_within!r} s and stays there (practical stability; c is the "
            f"ultimate bound). That set lies in {within}. Convergence to the goal or to rest is not claimed."
        )

    @property
    def _about_steps(self) -> str:
        """What a claim about steps is about, in words."""
        steps = self.claim.steps
        assert steps is not None
        return f"proved about the steps of this model ({steps.method}, Δt = {steps.dt!r} s, u held over each)"

    @property
    def _nominal_text(self) -> str:
        """A sentence on the nominal plant; empty for a claim about one plant."""
        if self.claim.plants is None:
            return ""
        made_for = ", ".join(f"{name} = {value!r}" for name, value in self.claim.plants.nominal.items())
        return f" u and V are those made for {made_for}: they do not depend on the plant."

    @property
    def disturbance(self) -> dict[str, float]:
        """The bound w_i of each disturbed state, by its name."""
        return named_disturbance(self.claim.disturbance, self.controller.system.state_names)

    @property
    def _origin(self) -> str:
        """A sentence on imported V and u; empty for trained ones."""
        policy = self.controller.closed_loop.policy
        return policy.origin if isinstance(policy, ValuePolicy) else ""

    def in_formulas(self) -> list[str]:
        claim, B = self.claim, self.claim.contraction
        rho = repr(claim.rho) if claim.rho > -float("inf") else "ρ"
        plants = ""
        if claim.plants is not None:
            plants = f", for each p = ({', '.join(claim.plants.nominal)}) ∈ P = {[*claim.plants.ranges.values()]}"
        inside = f"V > {rho} on the boundary of D{' and wherever h_j(x) ≥ 0' if claim.constraints else ''}"
        rounded = ""
        if claim.precision is not None:
            rounded = f", whatever u(0, x) is within its rounding in {claim.precision}"
        if claim.is_practical and claim.steps is None:
            c = repr(claim.hole) if claim.hole > 0 else "c"
            pushed = "".join(f", w({name}) = {w!r}" for name, w in self.disturbance.items())
            used, where = "u = u(0, x)", f"at each x ∈ D with {c} ≤ V ≤ {rho}"
            if claim.readings is not None:
                used = f"u = {control_of(claim.readings, 'u(0, x̂{})')}"
                where = (
                    f"at each x = x(t̂ + a) with V ≥ {c}, 0 ≤ a ≤ {claim.readings.longest!r}, after each reading x̂ ∈ D "
                    f"with V(x̂) ≤ {rho}"
                )
            return [
                f"V_xᵀ(f + g u){' + Σ w_i |∂V/∂x_i|' if pushed else ''} ≤ −{claim.decay!r} max(V, {c})  with "
                f"V = V(0, x), {used}{pushed}, {where}{plants}{rounded}",
                inside,
            ]
        hole, rate = (repr(claim.hole) if claim.hole > 0 else "c"), ("κ" if B is None else repr(B.rate))
        if claim.steps is not None:
            dt, d = repr(claim.steps.dt), repr(claim.decay)
            inside = [f"V > {rho} wherever h_j(x) ≥ 0"] if claim.constraints else []
            ends = (
                ["B", "Y"] if B is None
                else [f"B = [{B.box.lower.tolist()}, {B.box.upper.tolist()}]", f"Y = {B.coordinates.tolist()}"]
            )  # fmt: skip
            falls = [
                f"V(F(x)) ≤ (1 − {dt} · {d}) max(V(x), {hole}) and F(x) ∈ D  with V = V(0, x), x⁺ = F(x) one step with "
                f"u = u(0, x), at each x ∈ D with V ≤ {rho}{plants}{rounded}",
                *inside,
            ]
            if claim.is_practical:
                return falls
            return [
                *falls,
                f"V > {hole} > 0 on D without {ends[0]}",
                f"½(P J + JᵀP) + ½ · {dt} JᵀPJ ≤ −{rate} P  with P = YᵀY, J the Jacobian of (F(x) − x)/{dt}, at each "
                f"x ∈ B, where F is continuous{plants}{', without rounding' * bool(rounded)}; {ends[1]}",
            ]
        box = "B" if B is None else f"B = [{B.box.lower.tolist()}, {B.box.upper.tolist()}]"
        Y = "Y" if B is None else f"Y = {B.coordinates.tolist()}"
        return [
            f"V_xᵀ(f + g u) ≤ −{claim.decay!r} max(V, {hole})  with V = V(0, x), u = u(0, x), "
            f"at each x ∈ D with V ≤ {rho} that is not in B with V < {hole}{plants}{rounded}",
            f"{inside},  V > {hole} > 0 on the boundary of {box}",
            f"½(P J + JᵀP) ≤ −{rate} P  with P = YᵀY, J the Jacobian of f + g u, at each x ∈ B, where f + g u is "
            f"continuous{plants}{', without rounding' * bool(rounded)}; {Y}",
        ]

    def verdict_text(self) -> str:
        found = self.claim.counterexample
        why = {
            "certified": "it does",
            "falsified": "V does not fall so in the sublevel set around X₀ "
            f"(closed loops may still {'stay in it' if self.claim.is_practical else 'go to the goal'})",
            "unknown": self.claim.reason,
        }[self.verdict]
        plant = "".join(f", {name} = {value:.6g}" for name, value in self.claim.failing_plant.items())
        where = ""
        if found is not None:
            after = "" if self.claim.readings is None else f", {found.after:.3g} s after a reading there,"
            where = f" At x = {format_state(found.x)}{plant}{after} it fails by {found.condition:.3g}."
        but = f" but for {{V < {self.claim.hole!r}}}" if self.claim.is_practical and self.claim.hole > 0 else ""
        return f"The verdict is on the claim that a sublevel set on which V falls so{but} contains X₀: {why}.{where}"

    def figure(self) -> figures.Figure:
        controller, problem = self.controller, self.controller.problem
        labels = controller.system.state_labels
        return figures.region(
            self.claim, controller.V, problem.initial_states, problem.goal, labels, problem.constraints, self._paths()
        )

    def _paths(self) -> Tensor | None:
        """Closed loops over T from states just inside a region of two states, (times, k, n); None for other regions.

        If the claim is about several plants, each closed loop has a random one.
        """
        claim, loop, horizon = self.claim, self.controller.closed_loop, self.controller.horizon
        n, generator = claim.states.dimension, stream(0, CERTIFICATION)
        if n - len(claim.left_out) != 2:  # the closed loops would not lie in the slice
            return None
        x = claim.states.sample(20_000, generator).to(claim.states.lower)
        t = x.new_zeros(())
        with torch.no_grad():
            share = self.controller.V(t, x) / claim.rho
            x0 = x[(share <= 1) & (share > 1 - PATH_MARGIN)][:PATHS]
            if not len(x0):
                return None
            if claim.plants is not None:
                loop = self._loop
                x0 = torch.cat([x0, claim.plants.box.sample(len(x0), generator).to(x0)], -1)
            if claim.steps is not None:
                return self._simulate_steps(x0, horizon.steps)[..., :n]
            times = horizon.dt * torch.arange(horizon.steps + 1, dtype=x.dtype)
            paths = odeint(lambda _, x: loop.system.dynamics(x, loop.policy(t, x)), x0, times, method="rk4")
        return torch.as_tensor(paths)[..., :n]

    def _simulate_steps(self, x: Tensor, steps: int) -> Tensor:
        """Sequences of steps from some states, (1 + steps, k, n)."""
        condition, _ = self._stepped(
            self.claim.states if self.claim.plants is None else self.claim.plants.around(self.claim.states)
        )
        t, path = x.new_zeros(()), [x.double()]
        for _ in range(steps):
            path.append(condition.after(path[-1], condition.closed_loop.policy(t, path[-1])))
        return torch.stack(path)
