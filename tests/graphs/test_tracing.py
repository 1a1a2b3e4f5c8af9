"""Traced graphs compute the same as their functions, also after a cut."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from lyapnet.base.errors import UntraceableError, UsageError
from lyapnet.graphs.tracing import cut, trace


def function(weight, x, late):
    """Two early and two late results, one of which needs no late argument; with a derivative inside."""
    leaf = x.detach().requires_grad_()
    with torch.enable_grad():
        hidden = torch.tanh(leaf @ weight.mT + torch.ones(3).to(x))
        (slope,) = torch.autograd.grad((hidden**2).sum(), leaf)
    hidden = hidden.detach()
    return hidden.sum(-1), slope, (hidden * late).mT @ slope, torch.exp(hidden).mT


def draw():
    return torch.randn(3, 2), torch.randn(4, 2), torch.randn(4, 3)


def agree(results, expected):
    for result, value in zip(results, expected, strict=True):
        assert_close(result, value)
        assert not result.requires_grad


def operations(graph_module):
    return {getattr(node.target, "__name__", "") for node in graph_module.graph.nodes}


def test_trace_reads_its_arguments_and_nothing_else():
    scale = 1.0
    arguments = draw()
    graph = trace(lambda *a: tuple(scale * y for y in function(*a)), arguments)
    scale, others = 2.0, draw()
    for given in (arguments, others):
        agree(graph(*given), function(*given))
    with pytest.raises(AssertionError):
        agree(graph(*others), function(*arguments))


def test_nothing_is_computed_twice():
    (x,) = (torch.randn(3),)
    graph = trace(lambda x: (torch.sin(x) + 1, torch.sin(x) + 2), (x,))
    assert sum(node.target is torch.ops.aten.sin.default for node in graph.graph.nodes) == 1
    agree(graph(x), (torch.sin(x) + 1, torch.sin(x) + 2))


def test_shapes_that_are_changed_in_place():
    """torch uses such a change in a product with a vector; graphs that only change shapes are traced once."""
    calls = []

    def shaped(x):
        calls.append(None)
        column = x[:, None] * 2
        wide = column + 1
        column.squeeze_(1)
        return (torch.ones(3, 3).to(x) @ x, column, wide)

    x, other = torch.randn(2, 3)
    graph = trace(shaped, (x,))
    assert len(calls) == 1
    assert not any(node.target is torch.ops.aten.squeeze_.dim for node in graph.graph.nodes)
    agree(graph(other), shaped(other))

    def aliased(x):
        column = x[:, None] * 2
        alias = column.detach()
        column.squeeze_(1)
        return alias * x, column

    agree(trace(aliased, (x,))(other), aliased(other))


def test_tensors_that_are_filled_in_place_stay_apart():
    def fill(x):
        first, second = torch.zeros_like(x), torch.zeros_like(x)
        first[0] = x[1]
        second[1] = x[0] ** 2
        return (first + 2 * second,)

    x = torch.tensor([2.0, 3.0])
    agree(trace(fill, (x,))(x), fill(x))


TABLE = torch.tensor([1.0, 2.0, 3.0])
LEAVING = {
    "numpy": lambda x: torch.as_tensor(np.interp(x.detach().numpy(), [9.0, 10.0], [0.0, 1.0])),
    "data": lambda x: torch.from_numpy(np.sin(x.data.numpy())),
    "asarray": lambda x: torch.from_numpy(np.sin(np.asarray(x.detach()))),
    "tolist": lambda x: torch.tensor([2 * entry for entry in x.tolist()]),
    "dlpack": lambda x: 2 * torch.from_numpy(np.from_dlpack(x.detach())),
    "storage": lambda x: x * x.untyped_storage()[0],
    "float": lambda x: x * float(x.sum()),
    "item": lambda x: x * x[0].item(),
    "branch": lambda x: x if x.sum() > 0 else -x,
    "branch in NumPy": lambda x: 2 * x if (x.detach().numpy() > 9).any() else x,
    "index": lambda x: TABLE[(0 * x[0]).long()] * x,
    "mask": lambda x: x[x > 0].sum() + x,
    "loop": lambda x: sum((x for _ in range(int(x.abs().sum()))), x),
}


@pytest.mark.parametrize("way", LEAVING)
def test_code_that_reads_values_is_refused_where_it_does(way):
    """For any values: most of these functions are constant near these arguments."""
    function = LEAVING[way]

    def leaves(weight, x):
        return (weight * function(x),)

    weight, x = torch.randn(2, 4).unbind()
    with pytest.raises(UntraceableError) as refused:
        trace(leaves, (weight, x))
    message = str(refused.value)
    assert "read" in message
    assert way in ("mask", "item") or "test_tracing.py" in message, "it names the line"
    assert len(message.splitlines()) == 1
    assert "pytorch" not in message


def test_code_that_stays_in_torch_is_traced():
    def stays(weight, x):
        return (weight * torch.sin(x) * torch.tensor([1.0, 2.0, 3.0, 4.0]) * float(np.pi) + TABLE.sum(),)

    weight, x, other = torch.randn(3, 4).unbind()
    agree(trace(stays, (weight, x))(weight, other), stays(weight, other))


def test_a_function_of_more_than_its_arguments_is_found_out_on_other_values():
    calls = []

    def counts(x):
        calls.append(1)
        return (x * len(calls),)

    x, *others = torch.randn(3, 4).unbind()
    with pytest.raises(ValueError, match="computes something else each time"):
        trace(counts, (x,), [(other,) for other in others])
    agree(trace(lambda x: (2 * x,), (x,), [(other,) for other in others])(x), (2 * x,))


def test_random_numbers_are_refused():
    dropout = torch.nn.Dropout(0.5)
    with pytest.raises(UsageError, match="without random numbers"):
        trace(lambda x: (dropout(x),), (torch.ones(3),))
    agree(trace(lambda x: (dropout.eval()(x),), (torch.ones(3),))(torch.ones(3)), (torch.ones(3),))


# Cut


def test_both_parts_together_are_the_whole():
    arguments, others = draw(), draw()
    early, rest = cut(trace(function, arguments), late=1, early_outputs=2)
    for given in (arguments, others):
        expected = function(*given)
        first, second, *handed = early(*given[:-1])
        agree((first, second, *rest(*given, *handed)), expected)
    with pytest.raises(AssertionError):
        agree(rest(*others, *(torch.zeros_like(y) for y in handed)), expected[2:])


def test_the_rest_repeats_no_work():
    early, rest = cut(trace(function, draw()), late=1, early_outputs=2)
    assert "tanh.default" in operations(early) - operations(rest)


def test_the_rest_may_need_nothing_early_and_views_are_not_handed_over():
    arguments = draw()
    early, rest = cut(trace(lambda w, x, y: (w.sum(), x.mT @ y), arguments), late=1, early_outputs=1)
    (total,) = early(*arguments[:-1])
    agree((total, *rest(*arguments)), (arguments[0].sum(), arguments[1].mT @ arguments[2]))


@pytest.mark.parametrize("early_outputs", [3, 4])
def test_an_early_result_that_needs_a_late_argument_is_refused(early_outputs):
    with pytest.raises(KeyError):
        cut(trace(function, draw()), late=1, early_outputs=early_outputs)
