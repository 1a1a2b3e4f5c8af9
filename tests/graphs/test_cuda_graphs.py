"""Functions with recorded kernels; on a CPU a recording is replaced by running the function again."""

import pytest
import torch
from torch.testing import assert_close

from lyapnet.graphs.cuda_graphs import RecordedFunction
from tests.graphs.test_compilation import rollout_of


def run_again(run):
    """Run the function again on the memory of the recording."""
    run()
    return run


def test_arguments_are_copied_to_where_they_were_recorded_and_results_stay():
    given = [torch.ones(3), torch.tensor(2.0)]
    recorded = RecordedFunction(lambda x, y: (x * y, x.sum()), given, run_again)
    first = recorded(*given)
    second = recorded(torch.arange(3.0), torch.tensor(5.0))
    assert_close(first, [torch.full((3,), 2.0), torch.tensor(3.0)])
    assert_close(second, [torch.tensor([0.0, 5.0, 10.0]), torch.tensor(3.0)])
    given[0].fill_(9)
    assert_close(recorded(torch.ones(3), torch.tensor(1.0))[0], torch.ones(3))
    with pytest.raises(ValueError, match=r"Expected arguments \[\(3,\), \(\)\], got \[\(4,\), \(\)\]"):
        recorded(torch.ones(4), torch.tensor(1.0))


@pytest.mark.parametrize("overrides", [[], ["rollout.method=rk4"], ["rollout.costate_limit=1.01"]])
def test_a_recorded_loop_has_the_path_and_the_gradient_of_a_traced_one(overrides):
    rollout = rollout_of(*overrides)
    loop, x0 = rollout.discrete, rollout.problem.initial_states.sample(3)
    work, theta = loop._work(x0), loop.trained()
    traced, recorded = work.traced(), work.recorded(run_again)
    results = []
    for scale in (1.0, 1.3):
        with torch.no_grad():
            for parameter in theta:
                parameter.mul_(scale)
        pair = []
        for routines in (traced, recorded):
            nodes = loop.integrate(routines, scale * x0, theta)
            bars = [torch.randn(each.shape, generator=torch.Generator().manual_seed(1)) for each in shapes_of(nodes)]
            pair.append([*nodes, *flat(loop.gradient(routines, theta, nodes.stages, bars))])
        assert_close(*pair, rtol=1e-10, atol=1e-10)
        results.append(pair[0])
    assert not torch.allclose(results[0][0], results[1][0]), (
        "the counterpart: parameters and states are read at each call"
    )


@pytest.mark.gate
@pytest.mark.parametrize("policy", ["hjb", "sampled"])
@pytest.mark.parametrize("method", ["euler", "rk4"])
def test_nothing_is_copied_from_another_device(method, policy):
    """A recording on a GPU would not allow a copy; tensors without values stand for those of the GPU."""
    rollout = rollout_of(f"rollout.method={method}", f"rollout.policy={policy}").to("meta")
    loop, x0 = rollout.discrete, torch.zeros(3, 2, device="meta")
    work = loop._work(x0)
    work._visited = list
    for graph in (*work._forwards, *work._backwards, *work._block_pieces):
        for node in graph.graph.nodes:
            assert str(node.kwargs.get("device", "meta")) == "meta", node.format_node()
            assert "to_copy" not in str(node.target)


def shapes_of(nodes):
    """Like x, ∫ℓ and V at the nodes."""
    return nodes.stages[:, 0], nodes.value, nodes.value


def flat(gradient):
    costate, share = gradient
    return [costate, *share]
