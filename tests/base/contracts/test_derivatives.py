"""Derivatives of what others wrote: finite, right beside kinks and at them; wrong ones are found at both."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

import lyapnet
from lyapnet.base.contracts import check_function
from lyapnet.base.errors import UsageError
from lyapnet.base.interpolation import Table
from lyapnet.graphs.tracing import trace

AT_ZERO = torch.cat(
    [torch.zeros(32, 1), torch.linspace(-2, 3, 32)[:, None]], 1
).double()  # the first component is fixed
AROUND = torch.randn(32, 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64)


def check(component, x=AT_ZERO):
    """Hold f(x) = (component(x), x₁²) against its contract."""
    check_function("f(x)", lambda y: torch.stack([component(y), y[..., 1] ** 2], -1), [x], (2,), any_size=False)


class WrongRelu(torch.autograd.Function):
    """max(v, 0) with another slope."""

    slope = 3.0

    @staticmethod
    def forward(ctx, v):
        return torch.relu(v)

    @staticmethod
    def backward(ctx, *gradients):
        return WrongRelu.slope * gradients[0]


@pytest.mark.parametrize("x", [AT_ZERO, AROUND], ids=["at the kink", "around"])
@pytest.mark.parametrize(
    "kink",
    [
        lambda x: 400 * torch.relu(-x[..., 0]) - 9.81,
        lambda x: x[..., 0].abs() * x[..., 1],
        lambda x: torch.relu(x[..., 0]) - torch.relu(x[..., 0] + 1e-9),
        lambda x: torch.minimum(x[..., 0], 2 * x[..., 0]) + x[..., 1],
        lambda x: Table([[-1.0, 0.0, 2.0]], [3.0, 1.0, 5.0], method="linear")(x[..., :1]),
        lambda x: torch.where(x[..., 0] > 0, x[..., 0], 5 * x[..., 0]),
        lambda x: lyapnet.norm(x[..., :1]) * x[..., 0],
    ],
)
def test_kinks_are_kinks(kink, x):
    check(kink, x)


@pytest.mark.parametrize("x", [AT_ZERO, AROUND], ids=["at the kink", "around"])
@pytest.mark.parametrize(
    "wrong",
    [
        lambda x: 400 * torch.relu(-x[..., 0]).detach() - 9.81,
        lambda x: torch.relu(-x[..., 0]) + (x[..., 1] ** 3).detach(),
        lambda x: torch.as_tensor(np.maximum(x.detach().numpy()[..., 0], 0)) + 0 * x[..., 0],
        lambda x: WrongRelu.apply(x[..., 0]),
        lambda x: torch.relu(x[..., 0]) * 2 - torch.relu(x[..., 0]).detach(),
        lambda x: x[..., 0].detach(),
    ],
)
def test_wrong_derivatives_are_found_at_kinks_and_beside_them(wrong, x):
    with pytest.raises(UsageError, match="autograd's derivative as its own"):
        check(wrong, x)


@pytest.mark.parametrize(
    ("component", "slope"),
    [
        (lambda x: torch.sqrt(x[..., 0] ** 2) * x[..., 0], "nan"),
        (lambda x: torch.sqrt(x[..., 0]), "inf|nan"),
        (lambda x: (x[..., 0] ** 2) ** 0.5 * x[..., 0], "nan"),
        (lambda x: torch.where(x[..., 0] > 0, x[..., 0] * torch.log(x[..., 0]), 0.0), "nan"),
    ],
)
def test_slopes_that_are_not_finite_are_refused_with_their_state(component, slope):
    with pytest.raises(
        UsageError, match=rf"finite slopes, got -?({slope}) by x\[0\] at x = \(0, -2\); write .*lyapnet.norm"
    ):
        check(component)


def test_a_value_that_is_not_finite_is_refused_as_before():
    with pytest.raises(UsageError, match="Expected finite f"):
        check(lambda x: torch.log(x[..., 0]))


def test_norm_is_the_norm_with_slope_zero_at_zero():
    v = torch.tensor([[3.0, -4.0], [0.0, 0.0], [1e-9, 0.0]], requires_grad=True)
    assert_close(lyapnet.norm(v), torch.linalg.vector_norm(v, dim=-1))
    assert_close(lyapnet.norm(v, dim=0), torch.linalg.vector_norm(v, dim=0))
    (slope,) = torch.autograd.grad((lyapnet.norm(v) * v[:, 0]).sum(), v, create_graph=True)
    (curvature,) = torch.autograd.grad(slope.sum(), v)
    assert slope[1].tolist() == [0, 0]
    assert curvature.isfinite().all()
    assert_close(slope[0], torch.tensor([5 + 9 / 5, -12 / 5]))
    assert lyapnet.norm(torch.zeros(2, dtype=torch.float32)).dtype == torch.float32
    traced = trace(lambda x: (lyapnet.norm(x),), [v.detach()])
    assert_close(traced(v.detach())[0], lyapnet.norm(v).detach())
