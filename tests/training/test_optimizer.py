"""How weights move: Muon for matrices, AdamW for the rest."""

import copy
import math

import pytest
import torch
from torch import nn
from torch.testing import assert_close

from lyapnet.training.optimizer import MOMENTUM, Muon, OptimizerOptions, orthogonal


def numbers(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def network():
    """Layers 3 → 16 → 16 → 1, and data to fit."""
    layers = nn.Sequential(nn.Linear(3, 16), nn.Tanh(), nn.Linear(16, 16), nn.Tanh(), nn.Linear(16, 1)).double()
    for k, p in enumerate(layers.parameters()):
        p.data = numbers(*p.shape, seed=k) / math.sqrt(p.shape[-1])
    return layers


def take_steps(layers, optimizer, first, last):
    for k in range(first, last):
        x = numbers(64, 3, seed=100 + k)

        def loss(x=x):
            optimizer.zero_grad()
            value = (layers(x)[:, 0] - torch.sin(2 * x).sum(1)).square().mean()
            value.backward()
            return value

        value = optimizer.step(loss)
    return float(value.detach())


@pytest.mark.parametrize("shape", [(16, 16), (5, 12), (12, 5), (64, 3)])
def test_it_keeps_singular_vectors_and_makes_singular_values_alike(shape):
    M = numbers(*shape)
    U, S, Vt = torch.linalg.svd(M, full_matrices=False)
    turned = U.mT @ orthogonal(M) @ Vt.mT
    values = turned.diagonal()
    assert_close(turned, values.diag(), rtol=0, atol=1e-10)
    relative = S / M.norm()
    assert bool(((values > 0.6) & (values < 1.25))[relative > 0.02].all())
    assert_close(orthogonal(1e-9 * M), orthogonal(M), rtol=1e-6, atol=1e-6)
    assert bool(orthogonal(torch.zeros(shape)).eq(0).all())


def test_a_step_is_muons_along_matrices_and_adamws_along_the_rest():
    layers = network()
    before, adam = copy.deepcopy(layers), copy.deepcopy(layers)
    take_steps(layers, Muon(layers.parameters(), lr=0.01, weight_decay=0.1), 0, 1)
    take_steps(adam, torch.optim.AdamW(adam.parameters(), lr=0.01, weight_decay=0.1), 0, 1)
    for k, (was, now, other) in enumerate(
        zip(before.parameters(), layers.parameters(), adam.parameters(), strict=True)
    ):
        if k in (0, 2):  # matrices; the last layer has one row
            momentum = (1 - MOMENTUM) * now.grad
            direction = orthogonal(now.grad + MOMENTUM * (momentum - now.grad))
            expected = (1 - 0.01 * 0.1) * was - 0.01 * 0.2 * 4 * direction
            assert_close(now, expected)
            assert not torch.allclose(now, other, rtol=1e-3)
        else:
            assert_close(now, other, rtol=0, atol=0)


def test_torchs_own_takes_the_same_steps_up_to_its_rounding():
    """Which is to 8 bits: gradients that differ by rounding lead it apart."""
    one, other = nn.Parameter(numbers(16, 16)), nn.Parameter(numbers(16, 16))
    mine = Muon([one], lr=0.1, weight_decay=0.0)
    torchs = torch.optim.Muon([other], lr=0.1, weight_decay=0.0, adjust_lr_fn="match_rms_adamw")
    for k in range(5):
        one.grad = other.grad = numbers(16, 16, seed=k)
        mine.step()
        torchs.step()
    length = (one - numbers(16, 16)).norm()
    assert 1e-6 < float((one - other).detach().norm() / length.detach()) < 0.05
    gradient = numbers(16, 16, seed=9)
    assert_close(orthogonal(gradient * (1 + 1e-14 * numbers(16, 16))), orthogonal(gradient), rtol=1e-11, atol=1e-11)


def test_it_goes_on_exactly_from_its_state():
    whole, halves = network(), network()
    straight = Muon(whole.parameters(), lr=0.01)
    take_steps(whole, straight, 0, 8)
    first = Muon(halves.parameters(), lr=0.01)
    take_steps(halves, first, 0, 4)
    without = copy.deepcopy(halves)
    second = Muon(halves.parameters(), lr=0.5)
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    take_steps(halves, second, 4, 8)
    take_steps(without, Muon(without.parameters(), lr=0.01), 4, 8)
    for expected, found, other in zip(whole.parameters(), halves.parameters(), without.parameters(), strict=True):
        assert_close(found, expected, rtol=0, atol=0)
        assert not torch.equal(other, expected), "the state counts"


def test_what_has_no_gradient_stays_and_groups_have_rates_of_their_own():
    fast, slow, frozen = network(), network(), network()
    frozen.requires_grad_(False)
    before = copy.deepcopy(frozen.state_dict())
    optimizer = Muon([{"params": [*layers.parameters()]} for layers in (fast, slow, frozen)], lr=0.01)
    optimizer.param_groups[1]["lr"] = 0.0
    for layers in (fast, slow):
        layers(numbers(5, 3)).sum().backward()
    optimizer.step()
    assert all(p.grad is not None for p in fast.parameters()), "gradients stay for who records them"
    assert all(torch.equal(p, q) for p, q in zip(slow.parameters(), network().parameters(), strict=True))
    assert not any(torch.equal(p, q) for p, q in zip(fast.parameters(), network().parameters(), strict=True))
    assert all(torch.equal(p, before[name]) for name, p in frozen.state_dict().items())


def test_the_options_name_it():
    parameters = [*network().parameters()]
    assert type(OptimizerOptions("muon").optimizer(parameters)) is Muon
    assert type(OptimizerOptions().optimizer(parameters)) is torch.optim.Adam


def test_it_fits_a_function():
    layers = network()
    optimizer = OptimizerOptions("muon", 0.01).optimizer([*layers.parameters()])
    first = take_steps(layers, optimizer, 0, 1)
    assert take_steps(layers, optimizer, 1, 400) < 0.05 * first
