"""Whether the tests notice a changed line. python -m tests.mutations [--count 50] [--seed 0] [--first 1] [FOLDER …]

Each mutation changes one place of one file of the folders of lyapnet (prover, claims, value, loop and task by default),
drawn at random: a comparison is turned around, a sum becomes a difference, a number grows by a tenth, a minimum becomes
a maximum, a `not` goes, `and` becomes `or`. The tests of that folder, as they run by default, should then fail; first
they must pass without a mutation. A copy of the checkout is mutated, never the checkout itself.
"""

import argparse
import ast
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
FOLDERS = ["prover", "claims", "value", "loop", "task"]
PATIENCE = 3  # tests that take this many times as long as without a mutation have noticed it
COMPARISONS = {ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq}
ARITHMETIC = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult}
CALLS = {"min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum", "sin": "cos", "cos": "sin"}


class Mutation(NamedTuple):
    """One changed line."""

    file: str
    line: int
    before: str
    after: str


def mutations(source: str, file: str) -> Iterator[Mutation]:
    """All mutations of a source, each of one node within one line."""
    lines, tree = source.splitlines(), ast.parse(source)
    in_texts = {id(node) for text in ast.walk(tree) if isinstance(text, ast.JoinedStr) for node in ast.walk(text)}
    for node in ast.walk(tree):
        changed = None if id(node) in in_texts else _changed(node)
        if changed is not None and node.lineno == node.end_lineno:  # type: ignore[attr-defined]
            line = lines[node.lineno - 1]  # type: ignore[attr-defined]
            encoded = line.encode()
            start, end = node.col_offset, node.end_col_offset  # type: ignore[attr-defined]
            after = (encoded[:start] + f"({changed})".encode() + encoded[end:]).decode()
            yield Mutation(file, node.lineno, line, after)  # type: ignore[attr-defined]


def _changed(node: ast.AST) -> str | None:
    """The node's source with one change; None where there is none to make."""
    if isinstance(node, ast.Compare) and len(node.ops) == 1 and type(node.ops[0]) in COMPARISONS:
        return ast.unparse(ast.Compare(node.left, [COMPARISONS[type(node.ops[0])]()], node.comparators))
    if (
        isinstance(node, ast.BinOp)
        and type(node.op) in ARITHMETIC
        and not isinstance(node.left, ast.Constant | ast.List)
    ):
        return ast.unparse(ast.BinOp(node.left, ARITHMETIC[type(node.op)](), node.right))
    if isinstance(node, ast.BoolOp):
        return ast.unparse(ast.BoolOp(ast.Or() if isinstance(node.op, ast.And) else ast.And(), node.values))
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        return ast.unparse(node.operand)
    if isinstance(node, ast.Constant) and isinstance(node.value, float) and node.value:
        return repr(1.1 * node.value)
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name | ast.Attribute):
        name = node.func.id if isinstance(node.func, ast.Name) else node.func.attr
        if name in CALLS:
            return ast.unparse(node).replace(f"{name}(", f"{CALLS[name]}(", 1)
    return None


def is_noticed(mutation: Mutation, copy: Path, seconds: float) -> bool:
    """Whether the tests of a mutated file's folder fail, or do not end within the seconds."""
    path = copy / mutation.file
    source = path.read_text(encoding="utf-8")
    lines = source.splitlines(keepends=True)
    lines[mutation.line - 1] = mutation.after + "\n"
    path.write_text("".join(lines), encoding="utf-8")
    try:
        return failure(tests_of(mutation.file), copy, seconds) is not None
    except subprocess.TimeoutExpired:
        return True
    finally:
        path.write_text(source, encoding="utf-8")


def tests_of(file: str) -> tuple[str, ...]:
    """The folders of tests that should notice a mutation of a file."""
    folder = Path(file).parts[1]
    return ("tests/prover", "tests/claims") if folder in ("prover", "claims") else (f"tests/{folder}",)


def failure(tests: Sequence[str], copy: Path, seconds: float | None = None) -> str | None:
    """Run tests in the copy; the line that names the failed test, None if all pass."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "0", "-p", "no:cacheprovider", *tests]
    done = subprocess.run(command, cwd=copy, capture_output=True, text=True, timeout=seconds, check=False)
    if not done.returncode:
        return None
    lines = [line for line in (done.stdout + done.stderr).splitlines() if line.startswith(("FAILED", "ERROR"))]
    return lines[-1] if lines else f"exit code {done.returncode}"


def baseline(tests: Sequence[str], copy: Path) -> float:
    """The seconds that tests take in the copy without a mutation; exits if they fail."""
    begun = time.monotonic()
    if (line := failure(tests, copy)) is not None:
        sys.exit(f"Expected {' and '.join(tests)} to pass without a mutation, got {line!r}; correct that first.")
    return time.monotonic() - begun


def main() -> None:
    """Draw mutations, run the tests on each, and print a line for each and how many were noticed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", default=FOLDERS)
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=1, help="number of the first mutation to try")
    given = parser.parse_args()
    files = [path for folder in given.folders for path in sorted((ROOT / "lyapnet" / folder).rglob("*.py"))]
    each = [list(mutations(path.read_text(encoding="utf-8"), str(path.relative_to(ROOT)))) for path in files]
    draw = random.Random(given.seed)
    drawn = [draw.choice(some) for some in draw.choices([some for some in each if some], k=given.count)]
    noticed = 0
    with tempfile.TemporaryDirectory() as place:
        copy = Path(place) / "lyapnet"
        shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(".git", "logs", "__pycache__", ".venv", "dist"))
        tried = [(number, mutation) for number, mutation in enumerate(drawn, 1) if number >= given.first]
        groups = sorted({tests_of(mutation.file) for _, mutation in tried})
        seconds = {tests: baseline(tests, copy) for tests in groups}
        for number, mutation in tried:
            begun = time.monotonic()
            found = is_noticed(mutation, copy, PATIENCE * seconds[tests_of(mutation.file)])
            noticed += found
            print(
                f"{number:3} {'noticed' if found else 'MISSED '} {time.monotonic() - begun:4.0f} s  "
                f"{mutation.file}:{mutation.line}\n      - {mutation.before.strip()}\n      + {mutation.after.strip()}",
                flush=True,
            )
    print(f"noticed {noticed} of {len(tried)}")


if __name__ == "__main__":
    main()
