"""How often true parameters are in the 95 % regions of `lyapnet identify`: three plants, 60 s of noisy data each.

python -m tests.lab.identification.coverage [REPETITIONS [COLOUR [PLANT …]]]

COLOUR is the correlation of the noise from sample to sample, 0 for white noise.
"""

import sys
import time

import numpy as np
import torch

from lyapnet.lab.identification import Identification, identify
from tests.lab.identification.plants import PLANTS, record


def repeated(name: str, repetitions: int, colour: float = 0.0) -> list[Identification]:
    """What is identified of a plant, each time from other controls and other noise."""
    plant = PLANTS[name]
    recordings = record(plant, range(repetitions), colour=colour)
    return [identify(plant.settings(), [recording]) for recording in recordings]


def main(repetitions: int, colour: float, names: list[str]) -> None:
    """Print the table of docs/identify.md."""
    print("| plant | true p in the 95 % region | in each 95 % interval | half width | model called wrong |")
    print("|---|---|---|---|---|")
    for name in names:
        began, found, true = time.monotonic(), repeated(name, repetitions, colour), PLANTS[name].true
        inside = sum(each.contains(true) for each in found)
        own, half = [], []
        for parameter, value in true.items():
            estimates = [each.parameters[parameter] for each in found]
            own.append(f"{parameter} {sum(e.low <= value <= e.high for e in estimates)}")
            half.append(f"{np.mean([50 * (e.high - e.low) / value for e in estimates]):.2g} %")
        alarms = sum(not each.model_is_right for each in found)
        print(
            f"| {name} | {inside} of {repetitions} | {', '.join(own)} | {', '.join(half)} | {alarms} |"
            f" <!-- {(time.monotonic() - began) / repetitions:.1f} s each -->",
            flush=True,
        )


if __name__ == "__main__":
    torch.set_num_threads(1)
    torch.set_default_dtype(torch.float64)
    given = sys.argv[1:]
    main(int(given[0]) if given else 100, float(given[1]) if given[1:] else 0.0, given[2:] or [*PLANTS])
