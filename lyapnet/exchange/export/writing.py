"""Writing a controller's law: traced, written, held against the controller, and only then kept."""

import re
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from lyapnet import __version__
from lyapnet.base.errors import UsageError
from lyapnet.base.files import digest_of_file, write_atomically
from lyapnet.controller.controller import Controller
from lyapnet.exchange.export import c, programs
from lyapnet.exchange.export.law import Law
from lyapnet.exchange.export.verification import Agreement, verify
from lyapnet.value.law_after_horizon import BEYOND

FORMATS = {"c": "", "onnx": ".onnx", "torch": ".pt2"}  # ↦ how a file's name ends; c is a folder
PROGRAMS = {
    "onnx": (programs.onnx_model_of, programs.write_onnx, programs.run_onnx),
    "torch": (programs.program_of, programs.write_torch, programs.run_torch),
}


class Exported(NamedTuple):
    """What was written, and how far it is from the controller."""

    paths: list[Path]
    agreement: Agreement


def export(
    controller: Controller, path: str | Path, to: str, checkpoint: Path | None = None, name: str = c.NAME
) -> Exported:
    """Write u(t, x) and V(t, x) of a controller for use without lyapnet.

    Limits, target, parameters of a family and what follows T are inside; t below 0 counts as 0. What is written is run
    on 10 000 states and held against the controller; where they differ by more than rounding, nothing is kept.

    Args:
        path: of a folder for c, of a file for onnx and torch.
        to: a key of FORMATS: c, C99 without a library; onnx, a model (t, x[, p]) ↦ (u, V) of one state; torch, the
            same for torch.export.load.
        checkpoint: that the controller was loaded from, whose digest is then noted.
        name: what the names in C begin with: several laws in one program need several.

    Raises:
        UsageError: another format, a place that cannot be written to, or a name that is none in C.
        ExportError: the law cannot be written in it, or what was written is not that law.
    """
    path = Path(path)
    _require_place(path, to)
    _require_name(name, to, path)
    about, law = _about(controller, checkpoint), Law(controller)
    try:
        place = tempfile.TemporaryDirectory(dir=path.parent, prefix=".export_")
    except OSError as error:
        raise UsageError(f"Expected a place that can be written to, got {str(path)!r} ({error.strerror}).") from error
    with place as folder:
        draft = Path(folder)
        if to == "c":
            return _write_c(controller, law, about, draft, path, name)
        make, write, run = PROGRAMS[to]
        made, file = make(law), draft / path.name
        write(made, file, about)
        agreement = verify(controller, run(file, law))
        write(made, file, {**about, "verified": str(agreement)})
        write_atomically(path, file.read_bytes())
    return Exported([path], agreement)


def compiled(controller: Controller) -> c.CompiledLaw:
    """A controller's law as machine code, for a loop in Python: `.policy(t, x)` and `.value(t, x)` of one state.

    It is what `export` writes in C, held against the controller likewise.

    Raises:
        ExportError: as export.
    """
    with tempfile.TemporaryDirectory() as place:
        return _verified(controller, Law(controller), {}, Path(place), c.FAST)[0]


def _verified(
    controller: Controller, law: Law, about: dict[str, str], folder: Path, options: Sequence[str], name: str = c.NAME
) -> tuple[c.CompiledLaw, Agreement]:
    """The C of a law written into a folder, compiled, and held against the controller."""
    for file, text in c.sources(controller, law, about, name).items():
        (folder / file).write_text(text, encoding="utf-8")
    compiled_law = c.CompiledLaw(folder, law, controller.system.m, options, name)
    return compiled_law, verify(controller, compiled_law.of_many)


def _require_name(name: str, to: str, path: Path) -> None:
    """Refuse what cannot begin a name in C, a name where there are none, and another one than an earlier export's."""
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise UsageError(f"Expected a name of small letters, digits and _, a letter first, got {name!r}.")
    if to != "c" and name != c.NAME:
        raise UsageError(f"Expected no name for {to}, got {name!r}; the names in C alone have one.")
    header = path / "policy.h"
    if to == "c" and header.is_file() and f" {name}_control(" not in header.read_text(encoding="utf-8"):
        raise UsageError(
            f"Expected a name as in {str(header)!r}, whose main.c and CMakeLists.txt stay, got {name!r}; "
            "give the same, or another folder."
        )


def _require_place(path: Path, to: str) -> None:
    """Refuse another format, and a place where something else stands."""
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


def _write_c(controller: Controller, law: Law, about: dict[str, str], draft: Path, folder: Path, name: str) -> Exported:
    """The files of a C library; in a folder that has them, those of the law alone."""
    _, agreement = _verified(controller, law, about, draft, c.FLAGS, name)
    folder.mkdir(exist_ok=True)
    paths = []
    for file, text in c.sources(controller, law, {**about, "verified": str(agreement)}, name).items():
        if file not in c.YOURS or not (folder / file).exists():
            paths.append(folder / file)
            write_atomically(paths[-1], text.encode())
    return Exported(paths, agreement)


def _about(controller: Controller, checkpoint: Path | None) -> dict[str, str]:
    """What an export is, in lines for its metadata."""
    system, T = controller.system, controller.horizon.duration
    constants = set(system.constants)
    states = [i for i in range(system.n) if i not in constants]
    beyond = controller.law.beyond
    about = {
        "lyapnet": __version__,
        "checkpoint": "none" if checkpoint is None else f"{checkpoint}, SHA-256 {digest_of_file(checkpoint)}",
        "t": f"s, from 0 to {T:g}; after that {beyond}: {BEYOND[beyond]}",
        "x": _named(system.state_names, system.state_units, states),
        "u": _named(system.control_names, system.control_units, range(system.m)),
    }
    if constants:
        about["p"] = _named(system.state_names, system.state_units, sorted(constants))
    if controller.law.held:
        about["Δt"] = f"u is made to be held for {controller.horizon.dt:g} s"
    return about


def _named(names: Sequence[str], units: Sequence[str], which: Sequence[int]) -> str:
    return ", ".join(f"{names[i]} ({units[i]})" if units[i] else names[i] for i in which)
