"""Modules as functions of their parameters and buffers."""

from collections.abc import Callable, Sequence
from typing import Any

from torch import Tensor, nn
from torch.func import functional_call


def trained_of(module: nn.Module) -> list[Tensor]:
    """The parameters that require a gradient."""
    return [p for p in module.parameters() if p.requires_grad]


def untrained_of(module: nn.Module) -> list[Tensor]:
    """The other parameters and the buffers of a module."""
    return [*(p for p in module.parameters() if not p.requires_grad), *module.buffers()]


def state_of(module: nn.Module, trained: Sequence[Tensor] | None = None) -> list[Tensor]:
    """The parameters and buffers of a module, detached, the trained ones first; `trained` replaces these if given."""
    first = trained_of(module) if trained is None else trained
    return [tensor.detach() for tensor in (*first, *untrained_of(module))]


def stateless(module: nn.Module) -> Callable[..., Any]:
    """(*state, *arguments) ↦ module(*arguments), where `state` replaces the tensors of the module as in `state_of`.

    Trained parameters without a graph become leaves of a new one.
    """
    names_of = _names_of_tensors(module)
    trained, names = len(trained_of(module)), [names_of[each] for each in (*trained_of(module), *untrained_of(module))]

    def function(*tensors: Tensor) -> Any:
        leaves = [p if p.requires_grad else p.detach().requires_grad_() for p in tensors[:trained]]
        pairs = zip(names, (*leaves, *tensors[trained : len(names)]), strict=True)
        state = {name: tensor for all_names, tensor in pairs for name in all_names}
        # `state` has every name of a shared tensor; with tie_weights torch would miss modules that occur twice
        return functional_call(module, state, tuple(tensors[len(names) :]), tie_weights=False)

    return function


def _names_of_tensors(module: nn.Module) -> dict[Tensor, list[str]]:
    """Parameter or buffer ↦ its names; several if modules share it, but one for a module that occurs several times."""
    names: dict[Tensor, list[str]] = {}
    for prefix, part in module.named_modules():
        for name, tensor in (*part.named_parameters(recurse=False), *part.named_buffers(recurse=False)):
            names.setdefault(tensor, []).append(f"{prefix}.{name}" if prefix else name)
    return names
