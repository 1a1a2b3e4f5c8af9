"""Closed loops whose law is read at times, by an integrator of their own: random times, delays and errors."""

import torch


def held_loops(loop, x, duration, interval, delay=0.0, errors=None, control_errors=None, generator=None, fine=4,
               push=None, receding=False, shortest=0.5):  # fmt: skip
    """Yields (t, x, ∫ℓ) of closed loops from x (loops, n), by Runge-Kutta steps between all events of each loop.

    Readings of a loop are between `shortest` · interval and interval apart, half of them at the longest; each control
    is used after a delay of its own, half of them the longest; errors are of the largest size, with random signs.
    """
    generator = generator or torch.Generator().manual_seed(0)
    many, now, cost = len(x), torch.zeros(len(x)), torch.zeros(len(x))
    errors = torch.zeros(x.shape[-1]) if errors is None else torch.as_tensor(errors)

    def draw(low, high):
        some = low + (high - low) * torch.rand(many, generator=generator)
        return torch.where(torch.rand(many, generator=generator) < 0.5, torch.full((many,), float(high)), some)

    def sign(like):
        return 2.0 * torch.randint(2, like.shape, generator=generator) - 1

    def read(t, x):
        at = torch.zeros_like(t) if receding else t
        u = loop.policy(at, x + errors * sign(x))
        return u if control_errors is None else u + torch.as_tensor(control_errors) * sign(u)

    u = read(now, x)
    waiting, used_at, next_reading = u, torch.full((many,), torch.inf), draw(shortest * interval, interval)
    yield now, x, cost
    while bool((now < duration - 1e-12).any()):
        event = torch.minimum(torch.minimum(next_reading, used_at), torch.full((many,), float(duration)))
        step = ((event - now) / fine).clamp_min(0)
        w = 0.0 if push is None else torch.as_tensor(push) * sign(x)
        for _ in range(fine):
            x, paid = _runge_kutta(loop, x, u, step, w)
            now, cost = now + step, cost + paid
            yield now, x, cost
        use = used_at <= event
        u, used_at = torch.where(use[:, None], waiting, u), torch.where(use, torch.inf, used_at)
        reads = next_reading <= event
        fresh, d = read(now, x), draw(0.0, delay) if delay else torch.zeros(many)
        late = reads & (used_at < torch.inf)  # a control that was still waiting is used now, before its successor
        u = torch.where(late[:, None], waiting, u)
        waiting, used_at = torch.where(reads[:, None], fresh, waiting), torch.where(reads, now + d, used_at)
        at_once = reads & (d == 0)
        u, used_at = torch.where(at_once[:, None], fresh, u), torch.where(at_once, torch.inf, used_at)
        next_reading = torch.where(reads, now + draw(shortest * interval, interval), next_reading)


def _runge_kutta(loop, x, u, step, w):
    """(x, ∫ℓ) over one step with u and a push held."""
    h = step[:, None]

    def slope(x):
        both = loop.slope(x, u)
        return both[..., :-1] + w, both[..., -1]

    (k1, c1), states = slope(x), x
    k2, c2 = slope(states + h / 2 * k1)
    k3, c3 = slope(states + h / 2 * k2)
    k4, c4 = slope(states + h * k3)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), step / 6 * (c1 + 2 * c2 + 2 * c3 + c4)
