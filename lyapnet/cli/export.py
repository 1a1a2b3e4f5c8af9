"""lyapnet export."""

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from lyapnet.base.errors import UsageError
from lyapnet.cli.options import Debug, Delay, FirstDeviation, Given, Measured, add_estimator, with_controller_options


@with_controller_options
def export(
    given: Given,
    to: Annotated[str, typer.Option(help="c, fmu, onnx, torch, casadi or st.")],
    out: Annotated[Path, typer.Option(help="A folder for c, else a file.", metavar="PATH")],
    name: Annotated[str, typer.Option(help="Prefix of names in C and structured text.")] = "lyapnet",
    beyond: Annotated[
        str | None,
        typer.Option(help="The law after T: hold, receding or riccati; by default the one that keeps the goal."),
    ] = None,
    dtype: Annotated[
        str, typer.Option(help="Type of numbers in C and structured text: float64 or float32.")
    ] = "float64",
    fmi: Annotated[str, typer.Option(help="FMI version of an fmu: 2.0 or 3.0.")] = "2.0",
    estimator: Annotated[
        str | None,
        typer.Option(help="For c and fmu, also the loop with an estimator of the state from readings: ekf."),
    ] = None,
    outputs: Measured = None,
    deviation: FirstDeviation = None,
    delay: Delay = None,
    certified: Annotated[
        Path | None,
        typer.Option(
            help="For c: check this proof about the files, and write its claim into the header.", metavar="PROOF"
        ),
    ] = None,
    debug: Debug = False,
) -> None:
    """Write the control law for use without lyapnet, and compare it with the controller at 10 000 states.

    c is C99 without a library: policy.h, policy.c, main.c and CMakeLists.txt. fmu is a unit for
    co-simulation with that C inside. onnx is a model (t, x) ↦ (u, V) of one state, with p beside x for a family; torch
    is the same for torch.export.load, and casadi a function (t, x) ↦ (u, V, V_x) for casadi.Function.load. st is a
    function block in structured text for programmable controllers, compared at 400 states. With --estimator c and fmu
    have the loop, readings y ↦ u with a step for each Δt, held against Python's over 10 000 steps.
    """
    from lyapnet.exchange.export import export as write

    if estimator is None and (outputs or deviation or delay is not None):
        raise UsageError(
            "Expected --estimator with --outputs, --initial-deviation and --delay, got none; add --estimator ekf."
        )
    if certified is not None and (to != "c" or estimator is not None):
        got = f"--to {to}" if to != "c" else "--estimator"
        raise UsageError(f"Expected --certified with --to c and the law alone, got {got}; leave one of them out.")
    controller = given.load() if beyond is None else given.load().continued(beyond)
    exported = controller
    if estimator is not None:
        exported = add_estimator(controller, outputs or [], estimator, deviation, delay)
        if exported is None:
            raise UsageError("Expected --outputs, or outputs in the run's YAML, with --estimator, got none; name them.")
    given.report("writing and verifying")
    paths, agreement = write(exported, out, to, given.checkpoint, name, dtype, fmi)
    given.report.rest()
    notes = Console(highlight=False, markup=False)
    if beyond is None:
        quiet = "" if controller.problem.noise is None else "; these closed loops are without noise"
        notes.print(f"law: {controller.after_horizon()}{quiet}", soft_wrap=True)
    if exported is controller and controller.measures_outputs and to in ("c", "fmu"):
        notes.print(
            "note: the law alone, of the state; --estimator ekf adds the loop from its readings", soft_wrap=True
        )
    for path in paths:
        notes.print(f"wrote {path}", soft_wrap=True)
    notes.print(str(agreement), soft_wrap=True)
    if certified is not None:
        notes.print(_write_claim(controller, out, certified, given), soft_wrap=True)


def _write_claim(controller: Any, folder: Path, proof: Path, given: Given) -> str:
    """Check a proof about exported files, and write its claim into their header; return a sentence about it."""
    from lyapnet.claims.checking import check, claim_text
    from lyapnet.exchange.export.certified import CertifiedFiles

    files = CertifiedFiles(controller, folder, given.checkpoint)
    given.report("checking the proof")
    result = check(controller, proof, law=files.law())
    if result["verdict"] != "certified" or not result.get("computed_by"):
        got = result["reason"] or "one about u in real numbers"
        raise UsageError(
            f"Expected a proof of these files for --certified, got: {got} The files are written without a claim; prove "
            "one by lyapnet certify sound CKPT --keep PROOF --file FOLDER."
        )
    header = files.write_claim(claim_text(result))
    given.report.rest()
    return f"certified: {proof}, checked, is about these files; {header} states its claim"
