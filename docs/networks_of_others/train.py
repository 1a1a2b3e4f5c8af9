"""Train V(x) and u(x) of a pendulum in torch alone, and write them as V.onnx and u.onnx; 10 s on a CPU."""

import torch
from torch import nn

MASS, LENGTH, DAMPING, GRAVITY, TORQUE = 0.15, 0.5, 0.1, 9.81, 0.75
D = torch.tensor([4.0, 10.0])  # |θ|, |θ̇|
RHO, RATE = 0.93, 0.1  # of the level set to be, and how fast V falls in it, in 1/s


class AboutTheGoal(nn.Module):
    """net(x) − net(x*), which is 0 at x* = 0 for any weights."""

    def __init__(self, outputs):
        super().__init__()
        self.net = nn.Sequential(nn.Linear(2, 16), nn.Tanh(), nn.Linear(16, 16), nn.Tanh(), nn.Linear(16, outputs))

    def forward(self, x):
        return self.net(x / D) - self.net(torch.zeros_like(x))


class Value(AboutTheGoal):
    """0 at the goal, above 0 elsewhere, below 1."""

    def forward(self, x):
        return torch.tanh((super().forward(x) ** 2).sum(-1) + 0.1 * ((x / D) ** 2).sum(-1))


class Law(AboutTheGoal):
    """u* = 0 at the goal, within the limits everywhere."""

    def forward(self, x):
        return TORQUE * torch.tanh(super().forward(x))


def F(x, u):
    """ẋ of the pendulum, θ = 0 upright."""
    angle, velocity = x.unbind(-1)
    torque = MASS * GRAVITY * LENGTH * torch.sin(angle) - DAMPING * velocity + u[..., 0]
    return torch.stack([velocity, torque / (MASS * LENGTH**2)], -1)


torch.manual_seed(0)
V, u = Value(8), Law(1)
steps = 3000
optimizer = torch.optim.Adam([*V.parameters(), *u.parameters()], lr=3e-3)
schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
for step in range(steps):
    x = D * (2 * torch.rand(1000, 2) - 1)
    x[:250] *= torch.rand(250, 1)  # some of them closer to the goal
    x.requires_grad_()
    value = V(x)
    (slope,) = torch.autograd.grad(value.sum(), x, create_graph=True)
    inside = torch.sigmoid((RHO - 0.03 - value) / 0.02)
    wrong = inside * torch.relu((slope * F(x, u(x))).sum(-1) / (value + 0.01) + RATE)
    edge = D * (2 * torch.rand(200, 2) - 1)
    edge = edge / (edge / D).abs().amax(-1, keepdim=True)  # on the boundary of D
    loss = wrong.mean() + 10 * torch.relu(RHO - V(edge)).mean() + 0.2 * (1 - inside).mean()
    if step > steps // 3:  # second stage: what is worst counts most
        loss = loss + 0.3 * wrong.topk(20).values.mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    schedule.step()

batch = ({0: torch.export.Dim("batch")},)
for name, network in (("V", V), ("u", u)):
    torch.onnx.export(network, (torch.zeros(1, 2),), f"{name}.onnx", dynamo=True, dynamic_shapes=batch)
