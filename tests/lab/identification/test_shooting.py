"""Joined trajectories and their derivatives, against one long integration and finite differences."""

import numpy as np
import pytest
import torch

from lyapnet.lab.identification.measurements import NamedReadings
from lyapnet.lab.identification.shooting import Model, Shooting, rk4
from lyapnet.task.systems import ThreeLinkArm
from tests.lab.identification.plants import PLANTS, record


def shooting(name="cartpole", seconds=1.6, length=60, substeps=2, measured=("cart position", "pole velocity")):
    plant = PLANTS[name]
    (recording,) = record(plant, seconds=seconds, measured=measured)
    system = plant.cls(**plant.true).double()
    model = Model(system, list(plant.true), NamedReadings(system, recording.outputs))
    return Shooting(model, recording.pieces(length), substeps)


def start_of(shot):
    """Parameters, initial states of pieces, and states near by in which segments begin."""
    generator = np.random.default_rng(0)
    p = np.array([*PLANTS["cartpole"].true.values()])
    x0 = np.array([0.1, 2.8, 0.0, 0.2]) + 0.1 * generator.standard_normal((len(shot.pieces), 4))
    return p, x0, np.repeat(x0, shot.counts, 0)


def test_segments_are_joined_into_one_integration():
    shot = shooting()
    p, x0, nodes = start_of(shot)
    assert max(shot.counts) > 2
    path, read = shot(p, x0, nodes), []
    for piece, x in zip(shot.pieces, torch.from_numpy(x0), strict=True):
        for k in range(len(piece)):
            read.append(x[[0, 3]])
            h = (piece.t[k + 1] - piece.t[k]) / 2 if k + 1 < len(piece) else 0.0
            for _ in range(2):
                x = rk4(shot.model.system, x, torch.from_numpy(piece.u[k]), torch.tensor([h]))
    np.testing.assert_allclose(path.y, torch.stack(read).numpy(), atol=1e-8)


@pytest.mark.gate
def test_derivatives_are_those_of_finite_differences():
    shot = shooting()
    p, x0, nodes = start_of(shot)
    path, step = shot(p, x0, nodes), 1e-5
    owner = np.repeat(np.arange(len(shot.pieces)), [len(piece) for piece in shot.pieces])
    for i in range(4 + len(p)):
        way = step * np.eye(4 + len(p))[i]
        ends = [shot(p + s * way[4:], x0 + s * way[:4], path.nodes).y for s in (1, -1)]
        np.testing.assert_allclose(path.of_y[..., i], (ends[0] - ends[1]) / (2 * step), rtol=1e-5, atol=1e-6)
    changed = shot(p, x0 + step * (np.arange(len(x0)) == 0)[:, None], path.nodes).y
    assert (changed != path.y)[owner == 0].any()
    np.testing.assert_allclose(changed[owner > 0], path.y[owner > 0], atol=1e-9, err_msg="pieces do not touch")


def test_derivatives_of_a_system_that_inverts_its_mass_matrix():
    """Beyond two coordinates the inverse has a derivative of its own."""
    system = ThreeLinkArm().double()
    model = Model(system, ["damping"], NamedReadings(system, system.state_names[:1]))
    x, p = torch.randn(3, 6), torch.tensor([0.3])
    u = torch.randn(3, 3)

    def rates(system, x, u):
        return system.dynamics(x, u)

    found, step = model.derivatives(rates, x, p, u), 1e-6
    for i in range(7):
        way = step * torch.eye(7)[i]
        ends = [model.values(rates, x + s * way[:6], p + s * way[6:], u) for s in (1, -1)]
        torch.testing.assert_close(found[..., i], (ends[0] - ends[1]) / (2 * step), rtol=1e-5, atol=1e-6)


def test_trajectories_that_leave_are_none():
    shot = shooting()
    p, x0, nodes = start_of(shot)
    assert shot(p * 1e-9, x0, nodes) is None
    assert shot(p, x0 + 1e70, nodes) is None


@pytest.mark.parametrize("substeps", [1, 2])
def test_the_error_of_integration_falls_with_the_fourth_power(substeps):
    coarse, fine = shooting(substeps=substeps), shooting(substeps=2 * substeps)
    p, x0, nodes = start_of(coarse)
    errors = [shot.integration_error(shot(p, x0, nodes), p) for shot in (coarse, fine)]
    assert 10 < (errors[0] / errors[1]).max() < 22
