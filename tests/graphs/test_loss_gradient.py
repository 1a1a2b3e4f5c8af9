"""The gradient of a loss by the kernel equals torch's, also after the module changed, and without a kernel."""

import pytest
import torch
from torch import nn
from torch.testing import assert_close

from lyapnet.graphs import loss_gradient
from lyapnet.graphs.loss_gradient import gradient_of_loss


class Residual(nn.Module):
    """(x, y) ↦ the mean of (N(x) − y)², for a network that uses one layer twice, with a frozen weight and a buffer."""

    def __init__(self, round_trip=False):
        super().__init__()
        self.inner, self.output = nn.Linear(3, 3), nn.Linear(3, 1)
        self.again = self.inner
        self.frozen = nn.Parameter(torch.tensor(1.5), requires_grad=False)
        self.register_buffer("offset", torch.tensor(0.3))
        self.round_trip = round_trip  # leaves torch, which cannot be traced

    def forward(self, x, y):
        hidden = torch.tanh(self.again(torch.tanh(self.inner(x))))
        if self.round_trip:
            hidden = hidden + float(hidden.detach().sum()) * hidden
        return ((self.frozen * self.output(hidden)[:, 0] + self.offset - y) ** 2).mean()


def batch(seed):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(7, 3, generator=generator), torch.randn(7, generator=generator)


def by_torch(loss, arguments):
    return torch.autograd.grad(loss(*arguments), [p for p in loss.parameters() if p.requires_grad])


def slopes(loss):
    return [p.grad for p in loss.parameters() if p.requires_grad]


@pytest.mark.parametrize("round_trip", [False, True])
def test_it_is_torchs_gradient(round_trip, monkeypatch):
    torch.manual_seed(0)
    loss, built = Residual(round_trip), []
    monkeypatch.setattr(loss_gradient, "NumberKernel", lambda *given: built.append(1) or KERNEL(*given))
    differentiate = gradient_of_loss(loss, batch(0))
    assert bool(built) is not round_trip
    for seed in (1, 2):
        differentiate(*batch(seed))
        assert_close(slopes(loss), [*by_torch(loss, batch(seed))], rtol=1e-12, atol=1e-14)
        with torch.no_grad():  # in place, like an optimizer; and another buffer
            for p in loss.parameters():
                p.mul_(0.9)
        loss.offset = torch.tensor(-0.2)
    assert loss.frozen.grad is None


KERNEL = loss_gradient.NumberKernel


def test_a_parameter_that_the_loss_does_not_read_has_a_gradient_of_zero_or_none():
    loss = Residual()
    loss.unread = nn.Parameter(torch.ones(2))
    gradient_of_loss(loss, batch(0))(*batch(0))
    assert loss.unread.grad is None or not loss.unread.grad.any()


def test_a_batch_of_another_size_is_refused():
    differentiate = gradient_of_loss(Residual(), batch(0))
    with pytest.raises(ValueError, match="Expected arguments"):
        differentiate(*(column[:3] for column in batch(0)))


def test_parts_of_a_batch_give_the_same_gradient_on_any_number_of_threads(monkeypatch):
    loss, columns = Residual(), [torch.cat([column] * 64) for column in batch(0)]
    columns = [column[torch.randperm(len(column), generator=torch.Generator().manual_seed(1))] for column in columns]
    differentiate, found = gradient_of_loss(loss, columns), []
    sizes, run = set(), KERNEL.__call__
    monkeypatch.setattr(KERNEL, "__call__", lambda *given: sizes.add(len(given[-1])) or run(*given))
    for threads in (1, 2):
        monkeypatch.setattr("lyapnet.base.threads._of_programs", threads)
        differentiate(*columns)
        found.append(slopes(loss))
        assert_close(slopes(loss), [*by_torch(loss, columns)], rtol=1e-12, atol=1e-14)
    assert sizes == {224}, "448 rows in two parts"
    assert all(map(torch.equal, *found))
