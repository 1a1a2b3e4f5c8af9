"""Shared by all tests: shapes checked, float64, fixed seeds, every registered system and its task."""

import functools
import gc
import importlib
import inspect
import logging
import os
import sys

os.environ["MPLBACKEND"] = "Agg"

import hypothesis
import jaxtyping
import pytest
import torch

CHECKED_CALLS = 10  # of each function in each file; with all of them the tests take three times as long
_calls: dict[int, list[int]] = {}  # [number] of each piece of code


def _checked_at_first(typechecker):
    """jaxtyping's decorator, in effect for the first calls of a function in each file of tests."""

    def decorate(function):
        if inspect.isclass(function):
            if "__dataclass_params__" in vars(function):  # whose fields are what its __init__ takes
                function.__init__ = decorate(function.__init__)
            return function
        if function.__name__ == "__torch_function__":  # of a mode, through which users' errors pass: no line of theirs
            return function
        count = _calls.setdefault(id(function.__code__), [0])

        @functools.wraps(function)
        def call(*arguments, **options):
            count[0] += 1
            once = count[0] <= CHECKED_CALLS and not _of_any_size(arguments)
            return (checked() if once else function)(*arguments, **options)

        # Only when called: a function within a function is made anew each time, and most of these are not checked.
        def wrapped():
            return _jaxtyped(function, typechecker=typechecker)

        checked = functools.cache(wrapped)
        # Code of a library, as the one that they stand for: no part of what lyapnet's users wrote.
        for each in (call, wrapped):
            each.__code__ = each.__code__.replace(co_filename=jaxtyping.__file__)
        return call

    return decorate


def _of_any_size(arguments):
    """Whether one of them is a batch whose size has no value, which jaxtyping would ask for."""
    return any(isinstance(each, torch.Tensor) and torch.SymInt in map(type, each.shape) for each in arguments)


gc.set_threshold(10_000, 10, 5)  # by default a tenth of all time goes to the search for garbage

# What lyapnet imports first within its own modules would be compiled, and kept on disk, once more for the hook below.
for library in ("beartype.typing", "scipy.integrate", "scipy.linalg", "scipy.optimize", "torch._dynamo"):
    importlib.import_module(library)

_jaxtyped = jaxtyping.jaxtyped
jaxtyping.jaxtyped = _checked_at_first
# Before the first import of lyapnet; the numeric tower lets 1 pass for 1.0, as Python's own type rules do.
jaxtyping.install_import_hook("lyapnet", "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))")

from lyapnet.claims import funnel, preconditions  # noqa: E402
from lyapnet.loop.rollout import routines  # noqa: E402
from lyapnet.prover import bounds, counterexamples  # noqa: E402
from lyapnet.task.cost import QuadraticCost  # noqa: E402
from lyapnet.task.systems import SYSTEMS, ControlAffineSystem, ControlSystem  # noqa: E402
from lyapnet.value.networks import FCN, Scaling  # noqa: E402
from tests.problems import AFFINE, Quadratic  # noqa: E402

pytest_plugins = ("tests.gate",)

torch.set_num_threads(1)
logging.getLogger("torch.__trace").disabled = True  # no reader of logs in a test wants what torch writes of a trace
torch.set_warn_always(True)  # else a warning, an error here, would be raised by the first test that earns it only
hypothesis.settings.register_profile("lyapnet", database=None, derandomize=True, deadline=None, max_examples=30)
hypothesis.settings.load_profile("lyapnet")

# What a registered system needs to be built; the others are built from their defaults.
ARGUMENTS = {
    "linear": {"A": [[0.1, 1.0, 0.0], [0.0, -0.2, 1.0], [0.5, 0.0, -0.3]], "B": [[0.0, 1.0], [0.2, 0.0], [1.0, 0.3]]}
}


@pytest.fixture(scope="session", autouse=True)
def _cache(tmp_path_factory):
    """A cache of their own for all tests and the processes they start; xdist's workers share it."""
    folder = tmp_path_factory.getbasetemp()
    os.environ["LYAPNET_CACHE"] = str((folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder) / "cache")


@pytest.fixture(scope="module", autouse=True)
def _checked_anew():
    for count in _calls.values():
        count[0] = 0
    _float64_and_seed_0()  # for what a file makes once


@pytest.fixture
def as_users_call():
    """No call is checked from here on: for a test of what lyapnet says about an argument of another type."""
    for count in _calls.values():
        count[0] = CHECKED_CALLS


@pytest.fixture(autouse=True)
def _float64_and_seeded():
    _float64_and_seed_0()


def _float64_and_seed_0():
    torch.set_default_dtype(torch.float64)
    torch.manual_seed(0)


@pytest.fixture(autouse=True)
def _commands_say_no_more_than_they_find(monkeypatch):
    """On a slow machine they would also say what they are doing."""
    monkeypatch.setattr("lyapnet.cli.options.FIRST", float("inf"))


@pytest.fixture(autouse=True)
def _each_test_explores_by_itself(monkeypatch):
    """What the oracle remembers of other batches in this process."""
    module = sys.modules.get("lyapnet.evaluation.oracles.transcription")
    if module is not None:
        monkeypatch.setattr(module, "_SINGLE_MINIMUM_TASKS", set())


@pytest.fixture
def traced() -> bool | None:
    """Whether rollouts with the discrete costate run in a trace, or as they are written; None is their own choice.

    A trace takes seconds: tests of the mathematics override this with False, and run it in Python.
    """
    return None


@pytest.fixture(autouse=True)
def _form_of_rollouts(traced, monkeypatch):
    def forced(step):
        def run(*arguments, **options):
            if not traced:
                raise NotImplementedError
            try:
                return step(*arguments, **options)
            except Exception as error:  # which a rollout would take for a reason to run without a trace
                pytest.fail(f"Expected a trace, got {error!r}.")

        return run

    if traced is not None:
        for name in ("trace", "cut"):
            monkeypatch.setattr(routines, name, forced(getattr(routines, name)))


@pytest.fixture
def build_system():
    """name ↦ system; a registered system that cannot be built fails the tests."""

    def build(name: str) -> ControlSystem:
        try:
            return SYSTEMS[name](**ARGUMENTS.get(name, {}))
        except TypeError as error:
            pytest.fail(
                f"Expected arguments for {name!r} in conftest.ARGUMENTS, got none that fit ({error}); add them."
            )

    return build


@pytest.fixture(params=AFFINE)
def system(request, build_system) -> ControlAffineSystem:
    """Each registered control-affine system in turn, present and future."""
    return build_system(request.param)


@pytest.fixture
def cost(system) -> QuadraticCost:
    """A positive definite cost of the system, with R(x) its inverse mass where it has one."""
    Q = torch.diag(torch.linspace(1, 2, system.n)) + 0.1
    return QuadraticCost(Q, getattr(system, "inverse_mass", None) or torch.eye(system.m) + 0.1, 2 * Q)


@pytest.fixture
def V(system) -> FCN:
    """A small random network on the horizon [0, 1] s."""
    return FCN(Scaling([1.0] * system.n, duration=1.0, value=3.0), hidden=(8, 8))


@pytest.fixture
def quadratic():
    """V = xᵀPx; see problems.Quadratic."""
    return Quadratic


MARKS = pytest.StashKey[dict[str, set[str]]]()
LONG = (
    "test_false_attempts.py", "test_runs.py", "test_regions.py", "test_compare.py", "test_evil_files.py",
    "test_export.py", "test_operators.py", "test_kept_regions.py", "test_rules.py", "test_constraints.py",
    "test_start.py", "test_negative_controls.py", "test_readme.py", "test_settling.py", "test_refinement.py",
    "test_view.py", "test_kept_sides.py", "test_distributed.py", "test_family.py",
)  # fmt: skip


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items, config):
    """The files that take longest come first, so that no process is left alone with one of them."""
    items.sort(key=lambda item: item.path.name not in LONG)
    config.stash[MARKS] = {item.nodeid: {mark.name for mark in item.iter_markers()} for item in items}


@pytest.fixture(scope="session")
def marks(request) -> dict[str, set[str]]:
    """Id ↦ marks of all tests that were collected, also of those that do not run now."""
    return request.config.stash[MARKS]


def pytest_collection_finish():
    """What was imported stays, and is not searched for garbage."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="module", autouse=True)
def short_ascents():
    """Half of a proof of a small closed loop would be the ascent to counterexamples, on which no certificate relies.

    What it finds lowers the level that is proved; what it does not find is excluded by bounds alone. A file about
    counterexamples overrides this.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(counterexamples, "STEPS", 6)
        yield


@pytest.fixture(scope="module")
def few_seconds_for_levels():
    """What is sought beside a proof takes no longer than this; for tests where it decides no verdict."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(funnel, "MAX_LEVEL_SECONDS", 0.5)
        yield


@pytest.fixture(scope="module")
def one_closed_loop():
    """For a file about one closed loop: its parts are traced for batches of every size once.

    Each trace of a function is compared with it at 4 points instead of 32.
    """
    asked, check = [], preconditions.check_batch_sizes

    def once(*arguments):
        asked.append(arguments)
        return check(*arguments) if len(asked) == 1 else None

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(preconditions, "check_batch_sizes", once)
        patch.setattr(bounds, "TRACE_POINTS", 4)
        yield
