"""The proved region of a law that is read now and then, over how far apart the readings may be.

python docs/held_laws/region_over_interval.py FIGURE CKPT …, with checkpoints of conf/regions. Volumes are shares of the
region that is proved of the law read at every t. At a dotted line the closed loop that is linearised at the
goal and sampled has an eigenvalue of size 1: no region can be proved from there on.
"""

import sys

import matplotlib
import numpy as np
import torch
from matplotlib.figure import Figure
from scipy.linalg import expm

import lyapnet

SECONDS = 60  # for each proof
INTERVALS = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1)  # s
SETS = {"van_der_pol_region": [[-4.8, -10.8], [4.8, 10.8]], "path_tracking_wide_region": [[-10, -10], [10, 10]]}


def loses_stability(controller: lyapnet.Controller) -> float:
    """The least interval, on a fine grid, from which on the sampled linear closed loop does not contract."""
    x = controller.problem.goal.double()[None]
    u = torch.as_tensor(controller.policy(0.0, x[0].numpy())).double()
    A, B, K = (
        np.asarray(torch.autograd.functional.jacobian(each, at).double())
        for each, at in (
            (lambda x: controller.system.dynamics(x, u.to(x)), x[0]),
            (lambda u: controller.system.dynamics(x[0], u), u),
            (lambda x: controller.law(x.new_zeros(()), x), x[0].to(controller.initial_states.lower)),
        )
    )
    n, m = B.shape
    for interval in np.geomspace(1e-3, 10, 2000):
        whole = expm(interval * np.block([[A, B], [np.zeros((m, n + m))]]))
        if np.abs(np.linalg.eigvals(whole[:n, :n] + whole[:n, n:] @ K)).max() >= 1:
            return float(interval)
    return np.inf


def proved_volume(controller: lyapnet.Controller, claim: lyapnet.Region) -> float:
    """The volume of the region that is proved; 0 without one."""
    found = lyapnet.certify(controller, claim, budget=lyapnet.Budget(SECONDS))
    return found.result["region_volume_proved"] or 0.0


def main(figure: str, checkpoints: list[str]) -> None:
    """Prove each region at each interval, print the volumes, and draw them."""
    matplotlib.use("agg")
    canvas = Figure((6.4, 4), layout="constrained")
    axes = canvas.subplots()
    for checkpoint in checkpoints:
        controller = lyapnet.load(checkpoint)
        name = checkpoint.split("logs/")[-1].split("/")[0]
        region = {"states": SETS.get(name)}
        whole = proved_volume(controller, lyapnet.Region(**region))
        shares = []
        for interval in INTERVALS:
            claim = lyapnet.Region(**region, time="held", interval=interval)
            shares.append(proved_volume(controller, claim) / whole)
            print(f"{name}: {whole:.1f}; readings {interval:g} s apart: {shares[-1]:.3f}", flush=True)
        (line,) = axes.plot(np.multiply(1000, INTERVALS), shares, "o-", label=name.removesuffix("_region"))
        end = loses_stability(controller)
        print(f"{name}: unstable from {end:.3g} s on")
        axes.axvline(1000 * end, color=line.get_color(), ls=":")
    axes.set(
        xscale="log", ylim=(0, 1.05), xlabel="largest interval between readings (ms)",
        ylabel="volume / that of the law read at every t",
    )  # fmt: skip
    axes.legend()
    canvas.savefig(figure, dpi=130)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
