"""lyapnet zoo and lyapnet demo: the controllers that come with lyapnet."""

import time
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Column, Table

from lyapnet.cli.options import Debug, make_stages

LEAST_SHOWN = 1e-12  # smaller distances to the goal are printed as below this
STATES = 1000  # number of states that a demonstration draws for its certificate


def zoo(
    exports: Annotated[
        bool, typer.Option("--exports", help="Show the difference of each export from its controller.")
    ] = False,
    after: Annotated[
        bool, typer.Option("--after", help="Show the law after T, and how near the goal it stays.")
    ] = False,
    debug: Debug = False,
) -> None:
    """List the controllers that come with lyapnet, which any command takes as zoo:NAME in place of a checkpoint."""
    with make_stages("zoo") as report:
        report("importing torch")
        from lyapnet.claims.tables import floored
        from lyapnet.zoo import entries

    console = Console(highlight=False, markup=False)
    if exports:
        console.print(_tabulate_exports(entries()))
        return
    if after:
        console.print(_tabulate_after_horizon(entries()))
        return
    table = Table(Column("zoo:", no_wrap=True), "cost / optimum", "worst state", "error of V", "certified share of X₀")
    table.title = "Controllers that come with lyapnet"
    for one in entries():
        found, certificate = one.record["evaluation"], one.record["certificate"]
        table.add_row(
            one.name,
            f"{found['cost_ratio']:.4f}",
            f"{one.record['worst_ratio']:.4f}",
            f"{found['value_error']:.2%}",
            f"≥ {floored(certificate['probability_lower_bound'])}",
        )
    console.print(table)
    console.print("lyapnet demo NAME shows one; zoo:NAME stands for its checkpoint in any command.")


def demo(
    name: Annotated[str, typer.Argument(help="Of lyapnet zoo.", metavar="NAME")] = "cartpole_limited",
    out: Annotated[Path | None, typer.Option(help="The folder; else lyapnet_demo/NAME.", metavar="FOLDER")] = None,
    debug: Debug = False,
) -> None:
    """Show a controller of the zoo without training: its optimality, a certificate, figures and an animation."""
    began = time.monotonic()
    with make_stages("demo") as report:
        report(f"importing torch for {name}")
        from lyapnet.base.threads import use_threads
        from lyapnet.claims.certify import certify
        from lyapnet.claims.kinds import Statistical
        from lyapnet.evaluation.after_horizon import share_at_goal
        from lyapnet.evaluation.animation import Film
        from lyapnet.evaluation.figures import trajectories
        from lyapnet.value.after_horizon import HELD
        from lyapnet.zoo import entry

        use_threads(None)
        one, folder = entry(name), out or Path("lyapnet_demo", name)
        report("closed loops, and a certificate of them")
        controller = one.load()
        trajectory, ratio, error = one.measured(controller)
        certificate = certify(controller, Statistical(samples=STATES, confidence=1 - 1e-3, share=0.95))
        report("closed loops after T")
        measured = {
            "cost / optimum, ratio of the means": f"{ratio:.4f}",
            "value error, mean |V(0, x₀) − J*| / mean J*": f"{error:.2%}",
        }
        if (share := share_at_goal(controller, trajectory.x[0])) is not None:
            measured[f"after T, by {controller.law.beyond}: {HELD}, share"] = f"{share:.1%}"
        report("drawing and animating")
        shown = controller.rollout(trajectory.x[0, :5])
        folder.mkdir(parents=True, exist_ok=True)
        trajectories(shown, controller.problem).savefig(folder / "trajectories.png", dpi=150)
        Film(shown, controller.problem, controller.value).write(folder / "closed_loops.gif")
    console = Console(highlight=False, markup=False)
    console.print(_tabulate_measures(one.name, trajectory.x.shape[1], measured, certificate))
    console.print(f"{'made by':<10}{one.record['command']}", soft_wrap=True)
    console.print(f"{'wrote':<10}{folder / 'trajectories.png'}, {folder / 'closed_loops.gif'}", soft_wrap=True)
    for what, command in (
        ("measure", f"lyapnet evaluate zoo:{name}"),
        ("certify", f"lyapnet certify statistical zoo:{name}"),
        ("export", f"lyapnet export zoo:{name} --to c --out law"),
        ("use", f'lyapnet.load("zoo:{name}")'),
    ):
        console.print(f"{what:<10}{command}", soft_wrap=True)
    console.print(f"{time.monotonic() - began:.1f} s")


def _tabulate_exports(found: list[Any]) -> Table:
    formats = {to: None for one in found for precision in one.record["export"].values() for to in precision}
    table = Table(Column("zoo:", no_wrap=True), "precision", *formats, title="Exports against their controllers")
    for one in found:
        for precision, agreements in one.record["export"].items():
            largest = (max(agreements[to]["control"], agreements[to]["value"]) for to in formats)
            table.add_row(one.name, precision, *(f"{difference:.1e}" for difference in largest))
    table.caption = "Largest difference of u or V over 10 000 states, relative to the largest |u| or |V|."
    return table


def _tabulate_after_horizon(found: list[Any]) -> Table:
    """A table of the laws after T: how many closed loops each keeps, and how far from the goal."""
    from lyapnet.value.after_horizon import HELD

    multiples = list(found[0].record["afterwards"]["distance"])
    headings = ("‖x − x*‖ at T" if k == "1" else f"at {k} T" for k in multiples)
    table = Table(Column("zoo:", no_wrap=True), "after T", "held at 5 T", *headings, title="What follows T")
    for one in found:
        later = one.record["afterwards"]
        distances = (later["distance"][k] for k in multiples)
        shown = (f"{d:.2g}" if d > LEAST_SHOWN else f"< {LEAST_SHOWN:g}" for d in distances)
        table.add_row(one.name, later["beyond"], f"{later['held']} of {later['loops']}", *shown)
    lines = [f"Mean distance of 64 closed loops, in the states that the cost weighs; held: {HELD}."]
    reasons = {one.name: one.record["afterwards"]["reason"] for one in found}
    table.caption = "\n".join([*lines, *(f"{name}: {reason}" for name, reason in reasons.items() if reason)])
    return table


def _tabulate_measures(name: str, states: int, measured: dict[str, str], certificate: Any) -> Table:
    from lyapnet.claims.tables import floored

    table = Table("measure", "value", title=f"zoo:{name}, {states} states of X₀ that no training saw")
    for what, value in measured.items():
        table.add_row(what, value)
    *conditions, _ = certificate.in_formulas()
    share = f"share of X₀ with {', '.join(conditions)}, from {STATES} further states, confidence 0.999"
    table.add_row(share, f"≥ {floored(certificate.claim.probability_lower_bound)}")
    table.caption = "Optima from the record, computed beforehand; all else just now."
    return table
