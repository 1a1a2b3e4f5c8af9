"""The provenance of results: versions, platform, and the commit of lyapnet's source tree."""

import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from lyapnet import __version__

RUN_RECORD = "run.json"  # record of a run; its presence marks a run's folder
EVALUATION = "evaluation.json"  # written last: a run with this file is finished


def versions(*packages: str) -> dict[str, str]:
    """The versions of lyapnet, Python and some packages, if installed; and the platform."""
    found = {name: known for name in packages if (known := _version(name))}
    return {"lyapnet": __version__, **found, "python": platform.python_version(), "platform": platform.platform()}


def commit() -> str | None:
    """The commit of lyapnet's source tree; None if it is no git repository."""
    try:
        here = Path(__file__).parents[1]
        git = subprocess.run(["git", "rev-parse", "HEAD"], cwd=here, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return git.stdout.strip()


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
