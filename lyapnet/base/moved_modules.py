"""Aliases for the module names of version 0.3, so that old imports, configs and checkpoints still work."""

import sys
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

_FOLDERS = {  # current folder ↦ modules that were outside of it
    "base": "cluster contracts devices drawing errors files findings interpolation linear_algebra machine operators "
    "provenance random_streams shapes sizes tables types",
    "task": "constraints cost domain family horizon operating_points problem sets systems",
    "value": "after_horizon calculus derivatives expansions linearisation networks policy regulator",
    "loop": "programs rollout",
    "experiment": "checkpoint config recipe schema",
    "controller": "loading",
    "exchange": "importing view",
    "lab": "bench comparison",
}
_BOUNDS = "bound_kernel bound_rules bounds branches elementary_functions linear_systems rounding simplification taylor"
_SEARCH = "boxes branch_and_bound condition counterexamples kept_proofs proof stopping verdict workers"
MOVED = {
    **{name: f"{folder}.{name}" for folder, names in _FOLDERS.items() for name in names.split()},
    **{f"graphs.{name}": f"prover.{name}" for name in _BOUNDS.split()},
    **{f"certification.{name}": f"prover.{name}" for name in _SEARCH.split()},
    "beyond": "value.law_after_horizon",
    "build": "experiment.assembly",
    "certification": "claims",
    "comparison.sweep": "lab.sweep",
    "comparison.tuning": "lab.tuning",
    "evaluation.afterwards": "evaluation.after_horizon",
    "evaluation.afterwards_figure": "evaluation.after_horizon_figure",
    "training.facts": "training.task_facts",
    "training.relaxation": "training.penalty_weight",
    "zoo.making": "lab.zoo_making",
}
"""Module name in 0.3 ↦ current name, both without "lyapnet."; submodules move along."""


class MovedModules(MetaPathFinder):
    """Finds a module by its former name: the same module, not a copy."""

    def find_spec(self, fullname: str, path: Any, target: ModuleType | None = None) -> ModuleSpec | None:
        package, *parts = fullname.split(".")
        if package != "lyapnet" or not parts:
            return None
        if parts[0] == "export":
            raise ModuleNotFoundError(
                "lyapnet.export is a function since 0.4: lyapnet.export(controller, path, to='c'); what else was in "
                "that module is in lyapnet.exchange.export.",
                name=fullname,
            )
        for k in (2, 1):
            if (today := MOVED.get(".".join(parts[:k]))) is not None:
                name = ".".join(["lyapnet", today, *parts[k:]])
                return ModuleSpec(fullname, _CurrentModule(name))
        return None


class _CurrentModule(Loader):
    def __init__(self, name: str):
        self.name = name

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        module = import_module(self.name)
        self.spec = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        module.__spec__ = self.spec  # importlib has set the former name


def find_moved_modules() -> None:
    """Register the finder with precedence, because Python would load a second copy of a module by its former name."""
    if not any(isinstance(finder, MovedModules) for finder in sys.meta_path):
        sys.meta_path.insert(0, MovedModules())
