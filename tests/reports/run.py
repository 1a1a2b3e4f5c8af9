"""One report, trained by the default recipe and measured: python -m THIS NAME [--seed S] [--limit SECONDS]

As tests.tasks_without_goal.run does it, from the states of values.py.
"""

from pathlib import Path

from tests.reports.values import RIGHT
from tests.tasks_without_goal.run import Task, main

HERE = Path(__file__).parent


def task_of(name: str) -> Task:
    """A report whose optima are known."""
    return Task(HERE / name, list(RIGHT[name]), list(RIGHT[name].values()))


if __name__ == "__main__":
    main(list(RIGHT), task_of, __doc__)
