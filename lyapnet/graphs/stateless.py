"""Modules as functions of the tensors that they are made of."""

from collections.abc import Callable, Sequence
from typing import Any

from torch import Tensor, nn
from torch.func import functional_call


def trained_of(module: nn.Module) -> list[Tensor]:
    """The parameters that ask for a gradient."""
    return [p for p in module.parameters() if p.requires_grad]


def untrained_of(module: nn.Module) -> list[Tensor]:
    """What a module is made of besides its trained parameters."""
    return [*(p for p in module.parameters() if not p.requires_grad), *module.buffers()]


def state_of(module: nn.Module, trained: Sequence[Tensor] | None = None) -> list[Tensor]:
    """The tensors that a module is made of, the trained ones first, or others in their place; without graphs."""
    first = trained_of(module) if trained is None else trained
    return [tensor.detach() for tensor in (*first, *untrained_of(module))]


def stateless(module: nn.Module) -> Callable[..., Any]:
    """(*state, *arguments) ↦ module(*arguments), with the module made of `state`: trained parameters, then the others.

    The trained ones are leaves of a graph, unless they come with one.
    """
    places = _places(module)
    trained, names = len(trained_of(module)), [places[each] for each in (*trained_of(module), *untrained_of(module))]

    def function(*tensors: Tensor) -> Any:
        leaves = [p if p.requires_grad else p.detach().requires_grad_() for p in tensors[:trained]]
        made_of = zip(names, (*leaves, *tensors[trained : len(names)]), strict=True)
        state = {name: tensor for of_one, tensor in made_of for name in of_one}
        # ties are in `state`; torch, asked for them, leaves its own tensors in a module that occurs twice
        return functional_call(module, state, tuple(tensors[len(names) :]), tie_weights=False)

    return function


def _places(module: nn.Module) -> dict[Tensor, list[str]]:
    """Parameter or buffer ↦ its names: several where modules share it, one in a module that occurs several times."""
    places: dict[Tensor, list[str]] = {}
    for prefix, part in module.named_modules():
        for name, tensor in (*part.named_parameters(recurse=False), *part.named_buffers(recurse=False)):
            places.setdefault(tensor, []).append(f"{prefix}.{name}" if prefix else name)
    return places
