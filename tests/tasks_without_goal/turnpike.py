"""One task over horizons of any length, each with a V of its own: python -m THIS YEARS [--seed S] [--limit SECONDS]

What a village consumes: however long the horizon is, optimal plans lead to the golden rule, stay close to it, and leave
it only before the end. Trained and measured as `run` does it, from 64 states, against optima of `optima`.
"""

import numpy as np

from tests.tasks_without_goal.optima import Task as Program
from tests.tasks_without_goal.optima import Transcription, initial_states
from tests.tasks_without_goal.run import Task, main
from tests.tasks_without_goal.tasks import HERE

FOLDER, DT = HERE / "consumption", 0.1
HORIZONS = ("5", "20", "80")  # years
GOLDEN_RULE = (0.8 * 0.4 / 0.1) ** (1 / 0.6)  # capital that bears the greatest lasting consumption


def changes_for(years: str) -> list[str]:
    """What the file has otherwise for a horizon."""
    return [f"horizon.steps={round(float(years) / DT)}"]


def program_of(years: str) -> Program:
    """The task written a second time."""
    return Program(
        lambda x, u: [0.8 * x[0] ** 0.4 - 0.1 * x[0] - u[0]],
        lambda x, u: (u[0] - 3) ** 2 / 6 - 1.5,
        lambda x: -0.6 * x[0],
        ([0], [3]), ([2], [8]), round(float(years) / DT), DT, tried=(0, 0.6), domain={0: 0.1},
    )  # fmt: skip


def task_of(years: str) -> Task:
    """The task with the least costs from 64 states, each from two guesses."""
    program = program_of(years)
    search, states = Transcription(program), initial_states(program)
    found = [[search.solve(x, search.guess(share)) for share in (0.3, 0.6)] for x in states]
    optima = [min(each[0] for each in tried if each) for tried in found]
    return Task(FOLDER, np.asarray(states).tolist(), optima, changes_for(years))


if __name__ == "__main__":
    main(HORIZONS, task_of, __doc__)
