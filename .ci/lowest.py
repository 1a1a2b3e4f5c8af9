"""Prints the lowest versions that a pyproject.toml admits of what lyapnet imports, as constraints for pip."""

import sys
import tomllib
from pathlib import Path

from packaging.requirements import Requirement

EXTRAS = ("oracle", "onnx", "tune", "view", "baselines")

project = tomllib.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))["project"]
needed = [*project["dependencies"], *(line for extra in EXTRAS for line in project["optional-dependencies"][extra])]
for requirement in map(Requirement, needed):
    (lowest,) = (one.version for one in requirement.specifier if one.operator == ">=")
    print(f"{requirement.name}=={lowest}")
