"""A minute of a pendulum that is pushed at random, as a CSV file: python docs/identify/swing.py swing.csv"""

import sys

import numpy as np
import torch

from lyapnet import SYSTEMS

torch.set_default_dtype(torch.float64)
pendulum = SYSTEMS["pendulum"](mass=1.0, length=0.5, damping=0.1).double()
random, dt = np.random.default_rng(0), 0.02
x, rows = torch.tensor([np.pi, 0.0]), []  # hanging down
for k in range(3000):
    if k % 20 == 0:
        torque = torch.tensor([random.uniform(-1.5, 1.5)])  # N·m, held for 0.4 s
    rows.append([k * dt, float(torque), np.degrees(float(x[0]) + 0.01 * random.normal())])
    for _ in range(20):  # small steps of the midpoint method
        middle = x + dt / 40 * pendulum.dynamics(x, torque)
        x = x + dt / 20 * pendulum.dynamics(middle, torque)
np.savetxt(sys.argv[1], rows, "%.6g", ",", header="t,torque,angle [deg]", comments="")
