"""What tests of bounds share: functions of (t, x), random boxes and points in them, and a rule made wrong."""

import torch

import lyapnet

W = torch.tensor([[0.3, -1.2, 0.7], [0.1, 0.4, -0.9]])  # promoted to float64 by the bounds

FIRST = torch.tensor([0])


def weights(x):
    return W.to(x)


FUNCTIONS = {
    "affine": lambda t, x: x @ weights(x) + 0.1 * t - weights(x)[0] / 7,
    "product": lambda t, x: x[0] * x[1] * t - (x[0] + 0.3) * (x[0] - t),
    "quotient": lambda t, x: (x + t) / (3 + x[1]) + 2 / (4 - x),
    "power": lambda t, x: x**2 + x**3 - 0.2 * x**4 + (3 + x) ** -1 + (x + 3) ** 0.5,
    "exp": lambda t, x: torch.exp(x * t),
    "log1p": lambda t, x: torch.log1p(x**2 + t),
    "sqrt": lambda t, x: torch.sqrt(2.5 + x) + torch.rsqrt(4 + t),
    "reciprocal": lambda t, x: torch.reciprocal(x - 3) + torch.reciprocal(3 + x),
    "sigmoid": lambda t, x: torch.sigmoid(5 * x - t),
    "tanh": lambda t, x: torch.tanh(4 * x + t),
    "softplus": lambda t, x: torch.nn.functional.softplus(9 * x + 10 * t),
    "softplus of a beta": lambda t, x: torch.nn.functional.softplus(x, beta=3.0, threshold=1.0),
    "silu": lambda t, x: torch.nn.functional.silu(3 * x),
    "sin": lambda t, x: torch.sin(6 * x + t),
    "cos": lambda t, x: torch.cos(6 * x - 3 * t),
    "contact": lambda t, x: lyapnet.normal_force(x, x * t, 9.0, 0.1, 0.5) + lyapnet.friction_force(x, 1 + t, 0.4, 0.3),
    "sums": lambda t, x: torch.stack([x.sum(), x.mean(), (x[:, None] * x).sum(0).sum()]) - x.sum(0, keepdim=True),
    "matrices": lambda t, x: (x[:, None] * x) @ weights(x)[:, :2] @ torch.stack([x, x * t]) + torch.mv(x[:, None] * x, x),  # noqa: E501
    "arrangements": lambda t, x: torch.cat([x.flip(0)[:0], x[1:], t[None]]).unsqueeze(-1).expand(-1, 3).mT.reshape(-1),
    "index_add": lambda t, x: x.index_add(0, FIRST + 1, t[None]) + torch.zeros_like(x).index_add(0, FIRST, x[1:]),
}  # fmt: skip


def box(widths, boxes=120, n=2):
    """Boxes around random points of [0, 1] × [−1, 1]ⁿ."""
    center = torch.rand(boxes, 1 + n)
    center[:, 1:] = 2 * center[:, 1:] - 1
    half = widths / 2 * torch.rand(boxes, 1 + n)
    return center - half, center + half


def points_in(lower, upper, points=60):
    """Random points of each box, a third of them corners: (boxes, points, 1 + n)."""
    unit = torch.rand(len(lower), points, lower.shape[-1])
    unit[:, ::3] = unit[:, ::3].round()
    return lower[:, None] + (upper - lower)[:, None] * unit


def without_remainder(function):
    def wrong(*arguments, **keywords):
        form = function(*arguments, **keywords)
        return form.with_parts(form.terms, torch.zeros_like(form.radius))

    return wrong


SMOOTH = ["power", "exp", "log1p", "sqrt", "reciprocal", "sigmoid", "tanh", "softplus", "sin", "cos"]
