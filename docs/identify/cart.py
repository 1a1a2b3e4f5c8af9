"""40 s of a cart of 1 kg on a spring, with friction 0.4 v + CUBIC v³, read ± 5 mm under random forces.

python docs/identify/cart.py CUBIC FILE.csv
"""

import sys

import numpy as np

SECONDS, STEP, FINER, NOISE = 40.0, 0.05, 10, 0.005


def main(cubic: float, file: str) -> None:
    """Write the recording."""

    def rate(x, u):
        return np.array([x[1], u - 0.4 * x[1] - cubic * x[1] ** 3 - 2 * x[0]])

    random, count = np.random.default_rng(0), round(SECONDS / STEP)
    forces = np.repeat(random.uniform(-3, 3, count // 10), 10)
    x, rows, h = np.zeros(2), [], STEP / FINER
    for k, u in enumerate(forces):
        rows.append((k * STEP, u, x[0] + NOISE * random.normal()))
        for _ in range(FINER):  # the classical Runge–Kutta method
            a = rate(x, u)
            b = rate(x + h / 2 * a, u)
            c = rate(x + h / 2 * b, u)
            d = rate(x + h * c, u)
            x = x + h / 6 * (a + 2 * b + 2 * c + d)
    np.savetxt(file, rows, "%.6g", ",", header="t,force,position [m]", comments="")


if __name__ == "__main__":
    main(float(sys.argv[1]), sys.argv[2])
