"""Compares C in float32 with its bound: python -m tests.exchange.export.attack_file CKPT [--states 1000000].

Prints, on X₀ and [0, T], the bound of |u_C − u| for each control, the largest difference at random states, their ratio,
and the seconds of the bound; exit status 1 if a state is beyond it.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

import lyapnet
from lyapnet.controller.controller import Controller
from lyapnet.exchange.export import CertifiedFiles, export
from lyapnet.exchange.export.c import FLAGS, CompiledLaw, Style
from lyapnet.exchange.export.law import Law

BATCH = 10_000


def attack(controller: Controller, folder: Path, states: int) -> tuple[list[float], np.ndarray, float]:
    """(the bounds, the largest differences, seconds)."""
    export(controller, folder, "c", dtype="float32")
    started, box, m = time.monotonic(), controller.initial_states, controller.system.m
    law = CertifiedFiles(controller, folder).law()
    bounds, seconds = law.errors((box.lower.double(), box.upper.double())), time.monotonic() - started
    program = CompiledLaw(folder, Law(controller), m, FLAGS, Style(dtype=torch.float32))
    generator, largest = torch.Generator().manual_seed(0), np.zeros(m)
    for _ in range(0, states, BATCH):
        t, x = law.latest * torch.rand(BATCH, generator=generator, dtype=torch.float64), box.sample(BATCH, generator)
        with torch.no_grad():
            expected = controller.closed_loop.policy(t, x.double()).numpy()
        found = np.stack([program.policy(*one) for one in zip(t.tolist(), x.numpy(), strict=True)])
        largest = np.maximum(largest, np.abs(found - expected).max(0))
    return bounds, largest, seconds


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checkpoint")
    parser.add_argument("--states", type=int, default=1_000_000)
    options = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as place:
        bounds, largest, seconds = attack(lyapnet.load(options.checkpoint), Path(place) / "c", options.states)
    for bound, found in zip(bounds, largest.tolist(), strict=True):
        print(f"bound {bound:.3g}, largest of {options.states} {found:.3g}, ratio {bound / found:.3g}, {seconds:.3g} s")
    sys.exit(not all(largest <= bounds))
