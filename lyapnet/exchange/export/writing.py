"""Exports a controller's law: traces it, writes it, compares it with the controller, and keeps it if they agree."""

import re
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch

from lyapnet.base.errors import UsageError
from lyapnet.base.files import write_atomically
from lyapnet.controller.controller import Controller
from lyapnet.controller.output_feedback import OutputFeedback
from lyapnet.exchange.export import c, fmu, programs, structured_text
from lyapnet.exchange.export.c_loop import CompiledLoop, LoopTraces, verify_loop
from lyapnet.exchange.export.facts import facts_of
from lyapnet.exchange.export.law import Law
from lyapnet.exchange.export.verification import Agreement, points, verify

FORMATS = {"c": "", "fmu": ".fmu", "onnx": ".onnx", "torch": ".pt2", "casadi": ".casadi", "st": ".st"}
"""Format ↦ the ending of its file; c is a folder."""
IN_C = ("c", "fmu")
NAMED = (*IN_C, "st")  # formats with a name and a precision of their own
PROGRAMS = {
    "onnx": (programs.onnx_model_of, programs.write_onnx, programs.run_onnx),
    "torch": (programs.program_of, programs.write_torch, programs.run_torch),
    "casadi": (programs.casadi_function_of, programs.write_casadi, programs.run_casadi),
}
"""Format ↦ (law ↦ program, the function that writes a program, the function that runs a file)."""
DTYPES = {"float64": torch.float64, "float32": torch.float32}  # of the numbers in C and structured text
STATES_IN_PYTHON = 400  # of the states of a comparison, on which a function block is computed in Python


class Exported(NamedTuple):
    """The files of an export, and the differences from the controller."""

    paths: list[Path]
    agreement: Agreement


def export(
    exported: Controller | OutputFeedback,
    path: str | Path,
    to: str,
    checkpoint: Path | None = None,
    name: str = c.NAME,
    dtype: str = "float64",
    fmi: str = "2.0",
) -> Exported:
    """Write u(t, x) and V(t, x) of a controller for use without lyapnet; in C also its loop with an estimator.

    The export includes limits, target, parameters of a family and the law after T; t below 0 counts as 0. It is run on
    10 000 states, a loop over 10 000 steps, and compared with the controller. If they differ by more than rounding,
    nothing is kept. Structured text is computed in Python, on STATES_IN_PYTHON of these states.

    Args:
        exported: a controller; or a controller with an estimator, from controller.with_estimator("ekf").
        path: a folder for c, a file for the other formats.
        to: a key of FORMATS: c, C99 without a library; fmu, a unit for co-simulation with that C inside; st, a function
            block in structured text of IEC 61131-3 for programmable logic controllers; onnx, a model (t, x[, p]) ↦
            (u, V) of one state; torch, the same for torch.export.load; casadi, a function with V_x too, for
            casadi.Function.load.
        checkpoint: the checkpoint of the controller, for its digest in the files.
        name: the first part of all names in C and structured text, so that several laws fit into one program.
        dtype: float64 or float32, the type of the numbers in C and structured text (LREAL, REAL).
        fmi: the version of a unit's interface, 2.0 or 3.0.

    Raises:
        UsageError: the format, dtype or version is unknown, the path cannot be written, or the name is no name in C.
        ExportError: the law cannot be written in this format, or the export differs from it.
    """
    path = Path(path)
    _require_place(path, to)
    _require_name(name, to, path)
    _require_dtype(dtype, to)
    if fmi not in fmu.VERSIONS:
        raise UsageError(f"Expected fmi as one of {', '.join(fmu.VERSIONS)}, got {fmi!r}; choose one of them.")
    loop = exported if isinstance(exported, OutputFeedback) else None
    controller = exported.controller if isinstance(exported, OutputFeedback) else exported
    if controller is None:
        raise UsageError(
            "Expected an estimator of controller.with_estimator, got another one; its controller is needed."
        )
    if loop is not None and to not in IN_C:
        raise UsageError(
            f"Expected an estimator with --to {' or '.join(IN_C)}, got {to}; the others have the law alone."
        )
    facts, law = facts_of(controller, checkpoint), Law(controller, DTYPES[dtype] if to in NAMED else None)
    try:
        place = tempfile.TemporaryDirectory(dir=path.parent, prefix=".export_")
    except OSError as error:
        raise UsageError(f"Expected a place that can be written to, got {str(path)!r} ({error.strerror}).") from error
    with place as folder:
        draft = Path(folder)
        if to in IN_C:
            style = c.Style(name, DTYPES[dtype])
            written = Written(controller, law, facts, style, loop)
            return _write_c(written, draft, path) if to == "c" else _write_fmu(written, draft, path, fmi)
        if to == "st":
            return _write_structured_text(controller, law, facts, c.Style(name, DTYPES[dtype]), path)
        make, write, run = PROGRAMS[to]
        made, file = make(law), draft / path.name
        write(made, file, facts)
        agreement = verify(controller, run(file, law))
        write(made, file, {**facts, "verified": str(agreement)})
        write_atomically(path, file.read_bytes())
    return Exported([path], agreement)


def compiled(controller: Controller) -> c.CompiledLaw:
    """A controller's law as machine code of this process, for a loop in Python: `.policy(t, x)` and `.value(t, x)`.

    It takes one state at a time. It is the C that `export` writes, compared with the controller in the same way.

    Raises:
        ExportError: as export.
    """
    with tempfile.TemporaryDirectory() as place:
        return Written(controller, Law(controller), {}, c.Style(), None).verified(Path(place), c.FAST)[0]


class Written:
    """The C of a controller, with its loop if there is one: its text, and its differences from the controller.

    Args:
        facts: lines for the comment at the top of the files.
        style: names and precision.
        loop: the loop with an estimator, if it is exported too.
    """

    def __init__(
        self, controller: Controller, law: Law, facts: dict[str, str], style: c.Style, loop: OutputFeedback | None
    ):
        self.controller, self.law, self.style, self.loop = controller, law, style, loop
        self.traces = None if loop is None else LoopTraces(loop)
        self.facts = facts if self.traces is None else {**facts, **self.traces.facts()}
        self.tried = points(controller)

    def sources(self, claim: str = "", **more: str) -> dict[str, str]:
        """File name ↦ text.

        Args:
            claim: a claim about the files, for the header.
            more: further lines for the comment at the top.
        """
        facts = {**self.facts, **more}
        return c.sources(self.controller, self.law, facts, self.style, self.tried, self.traces, claim)

    def verified(self, folder: Path, options: Sequence[str]) -> tuple[c.CompiledLaw, Agreement]:
        """Write the C into a folder, compile it and compare it with the controller; (the law, the differences)."""
        for file, text in self.sources().items():
            (folder / file).write_text(text, encoding="utf-8")
        functions = c.library_of([folder / "policy.c"], options)
        law = c.CompiledLaw(folder, self.law, self.controller.system.m, options, self.style, functions)
        agreement = verify(self.controller, law.of_many, self.tried, self.style.dtype)
        if self.loop is None or self.traces is None:
            return law, agreement
        found = CompiledLoop(self.traces, functions, self.style)
        return law, agreement._replace(loop=verify_loop(self.loop, found, self.style.dtype))


def _require_name(name: str, to: str, path: Path) -> None:
    """Refuse a name that C or structured text does not allow, one for other formats, and another one in a folder."""
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise UsageError(f"Expected a name of small letters, digits and _, a letter first, got {name!r}.")
    if to == "st" and ("__" in name or name.endswith("_")):
        raise UsageError(f"Expected a name without __ and without _ at its end for st, got {name!r}; choose another.")
    if to not in NAMED and name != c.NAME:
        raise UsageError(f"Expected no name for {to}, got {name!r}; only {', '.join(NAMED)} have one.")
    header = path / "policy.h"
    if to == "c" and header.is_file() and f" {name}_control(" not in header.read_text(encoding="utf-8"):
        raise UsageError(
            f"Expected a name as in {str(header)!r}, whose main.c and CMakeLists.txt stay, got {name!r}; "
            "give the same, or another folder."
        )


def _require_dtype(dtype: str, to: str) -> None:
    """Refuse an unknown dtype, and float32 for formats that have the precision of the controller."""
    if dtype not in DTYPES:
        raise UsageError(f"Expected a dtype among {', '.join(DTYPES)}, got {dtype!r}; choose one of them.")
    if to not in NAMED and dtype != "float64":
        raise UsageError(f"Expected no dtype for {to}, got {dtype}; it has that of the controller.")


def _require_place(path: Path, to: str) -> None:
    """Refuse an unknown format, and a path at which there is something other than an earlier export."""
    if to not in FORMATS:
        raise UsageError(f"Expected a format among {', '.join(FORMATS)}, got {to!r}; choose one of them.")
    if not path.parent.is_dir():
        raise UsageError(
            f"Expected a place in a folder that exists, got {str(path)!r}; make {str(path.parent)!r} first."
        )
    if path.is_dir() != (to == "c") and path.exists():
        raise UsageError(f"Expected a {'folder' if to == 'c' else 'file'} for {to}, got {str(path)!r}; choose another.")
    if not path.name.endswith(FORMATS[to]):
        raise UsageError(f"Expected a name that ends in {FORMATS[to]} for {to}, got {path.name!r}; choose it so.")
    header = path / "policy.h"
    if (
        path.is_dir()
        and any(path.iterdir())
        and not (header.is_file() and header.read_bytes().startswith(b"/* lyapnet:"))
    ):
        raise UsageError(f"Expected a new folder, or that of an earlier export, got {str(path)!r}; choose another.")


def _write_c(written: Written, draft: Path, folder: Path) -> Exported:
    """Write the files of a C library; in the folder of an earlier export, only those of the law."""
    _, agreement = written.verified(draft, c.FLAGS)
    folder.mkdir(exist_ok=True)
    paths = []
    for file, text in written.sources(verified=str(agreement)).items():
        if file not in c.YOURS or not (folder / file).exists():
            paths.append(folder / file)
            write_atomically(paths[-1], text.encode())
    return Exported(paths, agreement)


def _write_fmu(written: Written, draft: Path, path: Path, version: str) -> Exported:
    """Write a unit for co-simulation."""
    _, agreement = written.verified(draft, c.FLAGS)
    variables = fmu.variables_of(written.controller, written.law, written.traces)
    sources, file = written.sources(verified=str(agreement)), draft / path.name
    looped, settings = written.traces is not None, 0 if written.traces is None else written.traces.settings
    fmu.write_fmu(file, version, sources, variables, written.style, written.controller, looped, settings, draft)
    write_atomically(path, file.read_bytes())
    return Exported([path], agreement)


def _write_structured_text(
    controller: Controller, law: Law, facts: dict[str, str], style: c.Style, path: Path
) -> Exported:
    """Write a function block."""
    tried, dtype = points(controller), style.dtype
    text = structured_text.structured_text(controller, law, style, tried)
    some = tried.every(len(tried.t) // STATES_IN_PYTHON)
    agreement = verify(controller, structured_text.run(text, law, dtype), some, dtype)
    comment = structured_text.comment({**facts, "verified": f"computed in Python, {agreement}"})
    write_atomically(path, (comment + text).encode())
    return Exported([path], agreement)
