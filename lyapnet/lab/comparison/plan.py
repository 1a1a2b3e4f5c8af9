"""The plan of a comparison: the schema of conf/compare.yaml, and its jobs."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import MISSING

from lyapnet.base.errors import UsageError, did_you_mean
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import Config, load_config
from lyapnet.experiment.schema import check_values, checked, read_yaml, setting
from lyapnet.lab.comparison.baselines.baseline import VALIDATIONS, Baseline
from lyapnet.lab.comparison.baselines.settings import SETTINGS
from lyapnet.lab.comparison.planners import planner_of
from lyapnet.lab.comparison.reference_problems import CONTROL_SCALES, BoundedProblem, bounded_problem
from lyapnet.lab.comparison.results import LEARNED, METHODS, OURS, PLANNED, Result
from lyapnet.lab.comparison.workers import Runnable

RESULT = "result.json"  # written last; a job with this file is finished


@dataclass
class ComparedTask:
    """One task, with the config for lyapnet and the budget of the baselines."""

    config: str = setting(MISSING, "The experiment of lyapnet, a YAML file; it also defines the task.")
    overrides: list[str] = setting([], "Changes to it, as key.sub=value.")
    control_scale: list[float] | None = setting(
        None, "Largest |u_i| of the baselines; null: the reference task's of that name.", above=0
    )
    hidden: list[int] = setting([64, 64], "Widths of the baselines' networks.", at_least=1)
    steps: dict[str, int] = setting(
        {}, "Environment steps of each baseline; one without is not compared here.", at_least=1
    )
    validations: dict[str, int] = setting(
        {}, f"Validations of each baseline; {VALIDATIONS} of one without.", at_least=1
    )
    options: dict[str, Any] = setting({}, "Options of a baseline's algorithm that differ from its setting's.")


@dataclass
class ComparisonConfig:
    """One comparison: every method on every task, from several seeds."""

    comparison: str = setting("compare", "Its name: everything goes to <logs>/<comparison>.", folder=True)
    logs: str = setting("logs", "The folder of all runs.")
    methods: list[str] = setting(list(LEARNED), f"What is compared; {', '.join(PLANNED)} too.")
    seeds: int = setting(5, "Seeds of lyapnet: 0, 1, …", at_least=1)
    baseline_seeds: int = setting(3, "Seeds of each baseline.", at_least=1)
    evaluation_states: int = setting(
        256, "States of X₀ on which all methods are measured, the same for all.", at_least=1
    )
    evaluation_paths: int = setting(
        32, "Paths of noise from each of them, the same for all methods, where a task has noise.", at_least=2
    )
    evaluation_seed: int = setting(0, "Seed with which those states and paths are drawn.", at_least=0)
    tasks: dict[str, ComparedTask] = setting({}, "What they are compared on, by name.")

    @property
    def folder(self) -> Path:
        """The folder of the comparison."""
        return Path(self.logs) / self.comparison


def load_comparison(path: str | Path, overrides: Sequence[str] = ()) -> ComparisonConfig:
    """The comparison of a YAML file with `key.sub=value` overrides.

    Raises:
        UsageError: the file or a value does not hold, as for the config of an experiment.
    """
    config = checked(ComparisonConfig, read_yaml(path, ComparisonConfig), overrides)
    check_values(config)
    if not config.tasks:
        raise UsageError(f"Expected at least one task under tasks in {str(path)!r}, got none; see conf/compare.yaml.")
    if not config.methods:
        raise UsageError(f"Expected at least one of {', '.join(METHODS)} under methods, got none.")
    for method in config.methods:
        _require_among(method, METHODS, "methods")
    for name, task in config.tasks.items():
        for key in ("steps", "validations", "options"):
            for method in getattr(task, key):
                _require_among(method, SETTINGS, f"tasks.{name}.{key}")
        for method, options in task.options.items():
            if not isinstance(options, dict):
                where = f"tasks.{name}.options.{method}"
                raise UsageError(f"Expected {where} as a section of options, got {options!r}; indent them below it.")
    return config


@dataclass(frozen=True, eq=False)
class Job(Runnable):
    """A method on a task, with a seed if it is trained, in its own folder."""

    comparison: ComparisonConfig
    task: str
    method: str
    seed: int
    origin: Sequence[str] = ()  # the command line of its comparison, after lyapnet

    @property
    def name(self) -> str:
        """task/method/seed_k, which is also its path in the comparison's folder."""
        return f"{self.task}/{self.method}/seed_{self.seed}"

    @property
    def folder(self) -> Path:
        """The folder of its checkpoints, curves and result."""
        return self.comparison.folder / self.name

    @property
    def command(self) -> list[str]:
        """The command that runs this job."""
        return [sys.executable, "-m", "lyapnet", *self.origin, "--job", self.name]

    @property
    def finished(self) -> bool:
        """Whether its result exists."""
        return (self.folder / RESULT).is_file()

    @property
    def result(self) -> Result | None:
        """Its result; None if it is not finished."""
        return Result.read(self.folder / RESULT) if self.finished else None

    @property
    def compared(self) -> ComparedTask:
        """The task's section."""
        return self.comparison.tasks[self.task]

    @property
    def settings(self) -> list[str]:
        """The overrides of lyapnet's own run."""
        place = f"{self.comparison.comparison}/{self.name}"
        return [*self.compared.overrides, f"seed={self.seed}", f"logs={self.comparison.logs}", f"experiment={place}"]

    @property
    def config(self) -> Config:
        """The resolved experiment."""
        return load_config(self.compared.config, self.settings)

    @property
    def bounded(self) -> BoundedProblem:
        """The task with the action box in which every method is measured.

        Raises:
            UsageError: no control scale.
        """
        scale = self.compared.control_scale or CONTROL_SCALES.get(self.task)
        return bounded_problem(build_problem(self.config), scale)

    @property
    def baseline(self) -> Baseline:
        """The baseline that SB3 trains.

        Raises:
            UsageError: no number of steps, or no control scale.
        """
        compared, method = self.compared, self.method
        if method not in compared.steps:
            raise UsageError(f"Expected {method} under tasks.{self.task}.steps, got none; give its environment steps.")
        options, validations = compared.options.get(method, {}), compared.validations.get(method, VALIDATIONS)
        return Baseline(
            self.bounded, method, self.seed, compared.steps[method], compared.hidden, options, validations
        )  # fmt: skip

    def check(self) -> None:
        """Check that the job can be trained or planned.

        Raises:
            UsageError: see `config`, `baseline` and planner_of.
        """
        if self.method == OURS:
            _ = self.bounded
        elif self.method in PLANNED:
            planner_of(self.method, self.bounded.problem)
        else:
            self.baseline.check()


def jobs_of(
    config: ComparisonConfig,
    tasks: Sequence[str] | None = None,
    methods: Sequence[str] | None = None,
    seeds: int | None = None,
    check: bool = True,
) -> list[Job]:
    """The jobs of a comparison, or of some of its tasks and methods, ordered by seed, so that all methods progress.

    Raises:
        UsageError: a task or method that it does not have, or one without steps; or a job that cannot be trained.
    """
    for task in tasks or ():
        _require_among(task, config.tasks, "--tasks")
    for method in methods or ():
        _require_among(method, METHODS, "--methods")
        if method in SETTINGS and not any(method in config.tasks[task].steps for task in tasks or config.tasks):
            raise UsageError(f"Expected {method} under steps of a task, got none; give its environment steps.")
    tasks, methods = list(dict.fromkeys(tasks or config.tasks)), list(dict.fromkeys(methods or config.methods))
    count = {m: seeds or (config.seeds if m == OURS else config.baseline_seeds) for m in methods}
    count |= {m: 1 for m in methods if m in PLANNED}  # these are deterministic
    jobs = [
        Job(config, task, method, seed)
        for seed in range(max(count.values()))
        for task in tasks
        for method in methods
        if seed < count[method] and _is_compared(config, task, method)
    ]
    if not jobs:
        raise UsageError(
            "Expected at least one job, got baselines without steps alone; see steps in conf/compare.yaml."
        )
    for job in jobs:
        if check and job.seed == 0:
            job.check()
    return jobs


def _is_compared(config: ComparisonConfig, task: str, method: str) -> bool:
    return method not in SETTINGS or method in config.tasks[task].steps


def begun_jobs(config: ComparisonConfig) -> list[Job]:
    """Those of the comparison's tasks and of any method and seed that have a folder."""
    return [
        Job(config, task, method, int(path.name.removeprefix("seed_")))
        for task in config.tasks
        for method in METHODS
        for path in sorted((config.folder / task / method).glob("seed_*"))
        if path.name.removeprefix("seed_").isdigit() and _is_compared(config, task, method)
    ]


def job_named(config: ComparisonConfig, name: str) -> Job:
    """The job task/method/seed_k.

    Raises:
        UsageError: it is not one of the comparison's.
    """
    task, _, rest = name.partition("/")
    method, _, seed = rest.partition("/seed_")
    _require_among(task, config.tasks, "--job")
    _require_among(method, METHODS, "--job")
    if not seed.isdigit():
        raise UsageError(f"Expected --job as task/method/seed_k, got {name!r}.")
    return Job(config, task, method, int(seed))


def _require_among(name: str, known: Any, where: str) -> None:
    if name not in known:
        hint = did_you_mean(name, known, "choose one of them.")
        raise UsageError(f"Expected {where} among {', '.join(known)}, got {name!r}; {hint}")
