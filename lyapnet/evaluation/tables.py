"""Tables of evaluations for the terminal."""

from collections.abc import Mapping
from typing import Any

from rich.table import Column, Table
from rich.text import Text

from lyapnet.base.tables import DIVERGED, ratio
from lyapnet.loop.programs import ValueProgram
from lyapnet.value.after_horizon import HELD

REGRET = "regret, mean (cost − optimum) / spread of the optimum"
ROWS = {
    "cost_mean": "cost J, mean",
    "cost_max": "cost J, worst",
    "optimal_cost_mean": "optimal cost, mean",
    "cost_ratio": "cost / optimum",
    "worst_ratio": "… of the worst state",
    "lost_fraction": "states that cost over 1.05 times their optimum",
    "arrival_time": "near the goal for good after, mean (s)",
    "arrived_fraction": "closed loops that arrive there, share",
    "regret": REGRET,
    "held_cost_mean": "in continuous time, u held for Δt: cost, mean",
    "held_cost_ratio": "in continuous time, u held for Δt: cost / optimum",
    "held_regret": f"in continuous time, u held for Δt: {REGRET}",
    "lqr_cost_mean": "LQR, without training: cost, mean",
    "lqr_cost_ratio": "LQR, without training: cost / optimum",
    "value_mean": "V(0, x₀), mean",
    "value_to_cost": "V(0, x₀) / cost J, ratio of the means",
    "value_error": "value error, mean |V(0, x₀) − J*| / mean J*",
    "constraint_loss": "constraint loss, mean",
    "terminal_error": "terminal error, mean ‖x(T)‖",
    "at_goal_fraction": f"{HELD}, share",
    "bounded_fraction": "cost J ≤ V(0, x₀), as a Lyapunov program asks, share of states",
    "falling_fraction": "V falls by half of each step's cost, within 1e-6 of V(0, x₀)",
    "largest_rise": "largest rise of V in a step, relative to V(0, x₀)",
    "satisfied_fraction": "condition holds within 1 % of V(0, x₀), share of K = 100",
    "satisfied_fraction_1e-3": "… within 0.1 %",
}
BOUNDS = ("bounded_fraction", "satisfied_fraction", "satisfied_fraction_1e-3")  # which a value program does not ask for
REFERENCES = ("held", "lqr")  # reference costs, shown as a ratio if the optimum is known
WITHOUT_NOISE = "closed loops without the task's noise"
LEFT_DOMAIN = "left_domain_fraction"
SHARES_IF_PRESENT = {
    "violated_fraction": "constraints violated, share of states",
    LEFT_DOMAIN: "domain left, share of states",
}


def evaluation_table(title: str, result: dict[str, Any]) -> Table:
    """The table of an Evaluation.result."""
    table = Table("measure", "value", title=f"{title}\n{result['samples']} unseen states of X₀, seed {result['seed']}")
    for key, label in _rows(result).items():
        table.add_row(label, _entry(key, result[key]))
    for label, entry in {**_noise_rows(result), **_plant_rows(result), **_estimator_rows(result)}.items():
        table.add_row(label, entry)
    for name, error in result.get("terminal_errors", {}).items():
        table.add_row(f"terminal error, mean |{name}|", f"{error:.4g}")
    for name, share in result.get("at_limits", {}).items():
        table.add_row(
            f"{name} at its lower, upper limit: share of steps (of states that meet one)",
            f"{share['lower']:.1%}, {share['upper']:.1%} ({share['states']:.0%})",
        )
    if border := result.get("at_border"):
        table.add_row(
            "controls on the border of their set: share of steps (of states that meet it)",
            f"{border['steps']:.1%} ({border['states']:.0%})",
        )
    for name, found in result.get("constraints", {}).items():
        table.add_row(f"{name}: greatest h, when", f"{found['worst']:.4g}, {found['time']:.4g} s")
    what = "J − M of one path" if "noise" in result else "cost J"
    for key, states in {"worst_corner": "corners of X₀", "worst_found": "states near the worst"}.items():
        if dearest := result.get(key):
            cost = "not finite" if dearest["cost"] is None else f"{dearest['cost']:.4g}"
            table.add_row(
                f"dearest of {dearest['count']} {states}: {what}, V(0, x₀)", f"{cost}, {dearest['value']:.4g}"
            )
    table.caption = _caption([result])
    return table


def _noise_rows(result: dict[str, Any]) -> dict[str, str]:
    """The rows of a task with noise."""
    if (noise := result.get("noise")) is None:
        return {}
    levels, optimum = noise["quantiles"], result.get("optimal_cost_mean")
    half_width = noise["with_risk_half_width"] if noise.get("risk") else noise["half_width"]
    relative = {"… relative to the optimum": f"± {half_width / optimum:.2g}"} if optimum and half_width else {}
    return {
        f"E J with its 95 % interval, {noise['paths']} paths from each state": (
            _interval(noise["mean"], noise["half_width"])
        ),
        **({} if noise.get("risk") else relative),
        "… from costs alone, without V as a control variate": (
            _interval(noise["plain_mean"], noise["plain_half_width"])
        ),
        **_risk_row(noise),
        **(relative if noise.get("risk") else {}),
        f"cost J of a path, quantiles {', '.join(levels)}": ", ".join(
            "infinite" if level is None else f"{level:.4g}" for level in levels.values()
        ),
        **(
            {"… mean of the dearest 5 % of the paths from a state": measured_or_not("", noise["dearest_mean"])}
            if "dearest_mean" in noise
            else {}
        ),
        "paths lost, which cost half more than V and not by their noise": f"{noise['lost_fraction']:.2%}",
    }


def _risk_row(noise: dict[str, Any]) -> dict[str, str]:
    """The row of the certainty equivalent in a task with risk."""
    if not noise.get("risk"):  # since version 0.4
        return {}
    equivalent = "not measured" if noise["with_risk"] is None else ""
    equivalent = equivalent or _interval(noise["with_risk"], noise["with_risk_half_width"])
    return {f"log E exp(θJ)/θ, θ = {noise['risk']:g}, with its 95 % interval": equivalent}


def _plant_rows(result: dict[str, Any]) -> dict[str, str]:
    """The rows of a task with random plants."""
    if (found := result.get("plants")) is None:
        return {}
    ratios = {
        "… / optimum of each plant, ratio of the means (largest)": " ".join(
            [measured_or_not("cost_ratio", found["cost_ratio"]), f"({measured_or_not('', found['largest_ratio'])})"]
        )
    }
    share = found["finite_fraction"]
    return {
        "on random plants, unknown to the law: cost J, mean": (
            f"not finite on {1 - share:.1%}" if share < 1 else f"{found['cost_mean']:.4g}"
        ),
        **(ratios if found["optimal_cost_mean"] is not None else {}),
    }


def _estimator_rows(result: dict[str, Any]) -> dict[str, str]:
    """The rows of a controller that reads outputs."""
    if (found := result.get("outputs")) is None:
        return {}
    read = ", ".join(f"{name} ± {noise:.3g}" for name, noise in found["readings"].items())
    late = f", each control {found['delay']} steps late" if found["delay"] else ""
    (low, high), nees = found["nees_band"], (found["nees"], found["nees_half_width"])
    ratio, half_width = found["cost_ratio"], found["half_width"]
    known, cost = (
        "not finite" if each is None else f"{each:.5g}" for each in (found["known_cost_mean"], found["cost_mean"])
    )
    return {
        f"with {found['estimator']} from {read}{late}": f"{found['runs']} runs",
        "… cost J, mean: state known, estimated": f"{known}, {cost}",
        "… their ratio, with its 95 % interval": "–" if ratio is None else f"{ratio:.4f}{_plus_minus(half_width)}",
        "… runs lost, which cost half more than with the state known": f"{found['lost_fraction']:.2%}",
        "… (x − x̂)ᵀP⁻¹(x − x̂)/n, mean: 1 if P is right": "not finite"
        if nees[0] is None
        else f"{nees[0]:.3f}{_plus_minus(nees[1])}",
        "… runs with an error at T that P allows one in a thousand": f"{found['outlier_fraction']:.2%}",
        f"… steps where its mean over runs is in the 95 % band, {low:.3f} to {high:.3f}": f"{found['nees_inside']:.0%}",
        **{
            f"… error of {name} at T, root mean square; √P": "not finite"
            if None in error
            else f"{error[0]:.3g}; {error[1]:.3g}"
            for name, error in found["errors"].items()
        },
    }


def _plus_minus(half_width: float | None) -> str:
    return "" if half_width is None else f" ± {half_width:.2g}"


def _interval(mean: float | None, half_width: float | None) -> str:
    """A mean with its interval; both are None if a path has no finite cost."""
    return "not finite" if mean is None or half_width is None else f"{mean:.5g} ± {half_width:.2g}"


def table_over_seeds(title: str, result: dict[str, Any]) -> Table:
    """The table of several seeds, from experiment.over_seeds: mean, standard deviation, least and most."""
    seeds = result["seeds"]
    table = Table("measure", *(Column(name, no_wrap=True) for name in ("mean ± spread", "least (seed)", "most (seed)")))
    table.title = f"{title}\n{len(seeds)} seeds, {seeds[0]['samples']} unseen states of X₀ each"
    for key, label in _rows(seeds[0]).items():
        if key not in result["mean"]:
            table.add_row(label, "–", "–", "–")
            continue
        ends = [choose(seeds, key=lambda one, key=key: one[key]) for choose in (min, max)]
        mean, spread = (measured(key, result[name][key]) for name in ("mean", "spread"))
        table.add_row(label, f"{mean} ± {spread}", *(f"{measured(key, end[key])} ({end['seed']})" for end in ends))
    table.caption = _caption(seeds)
    return table


def _rows(result: dict[str, Any]) -> dict[str, str]:
    """The labels of the rows of a result; reference costs as a ratio to the optimum, or as a mean if it is unknown."""
    known = result.get("regret", result["cost_ratio"]) is not None
    unknown = ("cost_mean",) if known else ("cost_ratio", "regret")
    left_out = {f"{name}_{key}" for name in REFERENCES for key in unknown}
    labels = {**ROWS, **SHARES_IF_PRESENT}
    if result.get("program") == ValueProgram.__name__:
        left_out.update(BOUNDS)
    if "regret" in result:
        left_out.add("cost_ratio")
        labels["value_error"] = "value error, mean |V(0, x₀) − J*| / spread of J*"
    return {key: label for key, label in labels.items() if key in result and key not in left_out}


def _entry(key: str, value: float | None) -> str:
    """Format a measure of a result; a reference cost without a number has diverged."""
    if value is None and key.startswith(REFERENCES):
        return DIVERGED
    return measured_or_not(key, value)


def _caption(results: list[dict[str, Any]]) -> Text | None:
    """Sentences about the model of the optimum, and why some optima are missing."""
    notes = dict.fromkeys(result["no_optimum"] for result in results if "no_optimum" in result)
    if about := results[0].get("optimum_of"):
        notes = {f"The optimum is that of {about}": None, **notes}
    if any((result.get("noise") or {}).get("with_risk") is not None for result in results):
        notes["Costs and the optimum are log E exp(θJ)/θ, of which V is the least"] = None
    if any((result.get("held_cost_ratio") or 1) < 1 for result in results):
        notes["A plant in continuous time may cost less than that optimum, because the steps overstate the cost"] = None
    notes |= {f"After T follows the law {result['after_T']}": None for result in results if "after_T" in result}
    caption = " ".join(f"{note.rstrip('.')}." for note in notes)
    return Text(caption) if notes else None  # Text, because [oracle] in a string would be markup


def robustness_table(
    rows: list[dict[str, Any]], samples: int, member: Mapping[str, float], noisy: bool, unchanged: Mapping[str, str]
) -> Table:
    """The table of costs under disturbances; for a family, in the task of one member.

    Args:
        noisy: whether the task has noise, which these costs are without.
        unchanged: name ↦ reason of the parameters without a row.
    """
    named = ", ".join(f"{name} = {value:g}" for name, value in member.items())
    title = f"{samples} states each" + f" of the member {named}" * bool(named)
    headings = ("cost J", "optimum J*", "J / J*", "‖x(T)‖")
    columns = [Column(heading, justify="right") for heading in headings]
    table = Table("disturbance", *columns, title=f"disturbances that the controller does not know\n{title}")
    for row in rows:
        keys = ("cost_mean", "optimal_cost_mean", "cost_ratio", "terminal_error")
        cost, *others = (measured_or_not(key, row[key]) for key in keys)
        table.add_row(row["disturbance"], "diverged" if row["cost_mean"] is None else cost, *others)
    costs = f"J and J*: {WITHOUT_NOISE}. " if noisy else ""
    left = ", ".join(f"{name.replace('_', ' ')} ({why})" for name, why in unchanged.items())
    table.caption = Text(f"{costs}J*: the optimum if the disturbance is known" + f". Not varied: {left}" * bool(left))
    return table


def simulator_table(row: Mapping[str, float], plant: str, samples: int) -> Table:
    """The table of closed loops in MuJoCo, from SimulatedLoops.summary."""
    columns = (
        "cost J in MuJoCo",
        "J of the model",
        "ratio",
        "largest ratio",
        "finite",
        "at most 1.1 times the model's",
    )
    table = Table(*(Column(name, justify="right") for name in columns), title=f"in MuJoCo on {plant}, {samples} states")
    keys = ("simulated_cost_mean", "model_cost_mean", "cost_ratio", "largest_ratio")
    shares = (f"{row[key]:.0%}" for key in ("finite_fraction", "as_good_fraction"))
    table.add_row(*(f"{row[key]:.4g}" for key in keys), *shares)
    table.caption = "both in continuous time with u held for Δt"
    return table


def after_horizon_table(rows: list[dict[str, Any]], samples: int, noisy: bool) -> Table:
    """The table of distances after T under each law, from after_horizon.in_plain_data.

    Args:
        noisy: whether the task has noise, which these closed loops are without.
    """
    columns = [Column(f"at {at['time']:g} s", justify="right") for at in rows[0]["distances"]]
    table = Table("beyond", *columns, title=f"what follows T: mean ‖x − x*‖ of {samples} closed loops")
    refused = [WITHOUT_NOISE] if noisy else []
    for row in rows:
        table.add_row(row["beyond"], *("–" if at["mean"] is None else f"{at['mean']:.3g}" for at in row["distances"]))
    refused += [f"{row['beyond']}: {row['refused']}" for row in rows if row["refused"]]
    table.caption = Text("\n".join(refused)) if refused else None
    return table


def measured_or_not(key: str, value: float | None) -> str:
    """Format a measure of an evaluation; a dash if it is unknown."""
    return "–" if value is None else measured(key, value)


def measured(key: str, value: float) -> str:
    """Format a measure of an evaluation: ratios with four decimals, shares in percent."""
    if key.endswith("cost_ratio"):
        return ratio(value)
    if key.endswith("regret"):
        return f"{value:.2%}"
    return f"{value:.1%}" if key.split("_1e")[0].endswith("fraction") else f"{value:.4g}"
