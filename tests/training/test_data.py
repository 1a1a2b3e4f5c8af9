"""Initial states: every batch a function of (seed, process, step), no stream shared."""

import itertools
from types import SimpleNamespace

import pytest
import torch

from lyapnet.base.errors import CheckpointError
from lyapnet.base.random_streams import FIGURES, TEST, TRAINING, VALIDATION, stream
from lyapnet.task.sets import Box
from lyapnet.task.systems import Linear
from lyapnet.training.data import InitialStateDataModule
from tests.problems import problem_of

X0 = Box([-1.0, 2.0, 0.0], [1.0, 3.0, 0.0])


def states(seed=0, step=None, process=0, length=1):
    """A data module, in a trainer that stands at a step if one is given."""
    problem = problem_of(Linear(torch.eye(3), torch.eye(3)), initial_states=X0)
    module = InitialStateDataModule(problem, batch_size=16, validation_states=32, seed=seed, steps_per_epoch=length)
    if step is not None:
        module.trainer = SimpleNamespace(global_step=step, global_rank=process)
    return module


def only(loader):
    """The one batch of a loader."""
    (batch,) = loader
    return batch


def test_batch_depends_on_seed_process_and_step_alone():
    places = list(itertools.product((0, 1, 2**40), (0, 1, 7), (0, 1, 100)))  # seed, process, step
    batches = {place: states(place[0]).batch(place[2], place[1]) for place in places}
    for (seed, process, step), batch in batches.items():
        assert batch.shape == (16, 3)
        assert torch.equal(batch, states(seed).batch(step, process))
    for one, other in itertools.combinations(places, 2):
        assert not torch.equal(batches[one], batches[other]), (one, other)


def test_batch_ignores_the_global_generator():
    torch.manual_seed(1)
    batch = states().batch(3)
    torch.manual_seed(2)
    assert torch.equal(states().batch(3), batch)


def test_loader_draws_the_trainers_step_and_process():
    module = states(step=5, process=2)
    loader = module.train_dataloader()
    assert len(loader) == 1
    assert torch.equal(only(loader), states().batch(5, process=2))
    module.trainer.global_step = 6
    assert torch.equal(only(loader), states().batch(6, process=2))


@pytest.mark.parametrize("step", [8, 9, 11])
def test_an_epoch_of_several_steps_draws_what_each_of_them_would(step):
    """Also one that is resumed midway, where Lightning skips what an epoch has behind it."""
    loader = states(step=step, length=4).train_dataloader()
    assert len(loader) == 4
    for drawn, expected in zip(loader, range(8, 12), strict=True):
        assert torch.equal(drawn, states().batch(expected))


def test_validation_states_never_change():
    first = only(states(step=0).val_dataloader())
    assert first.shape == (32, 3)
    assert torch.equal(only(states(step=9, process=1).val_dataloader()), first)
    assert not torch.equal(only(states(seed=1).val_dataloader()), first)


def test_every_draw_lies_in_the_set_and_fills_it():
    drawn = torch.cat([states().batch(step) for step in range(40)] + [only(states().val_dataloader())])
    assert X0.contains(drawn).all()
    low, high = drawn.amin(0), drawn.amax(0)
    assert ((low - X0.lower) <= 0.02 * X0.widths).all()
    assert ((X0.upper - high) <= 0.02 * X0.widths).all()


def test_streams_are_distinct():
    """No two purposes, processes, steps or seeds share a stream, whatever the lengths of their paths."""
    training = itertools.product([TRAINING], range(4), range(4))
    paths = [(VALIDATION,), (TEST,), (FIGURES,), (TRAINING,), (TRAINING, 0), *training]
    drawn = {(seed, path): stream(seed, *path).initial_seed() for seed in (0, 1, 5, 2**32, 2**33 + 1) for path in paths}
    assert len(set(drawn.values())) == len(drawn)


def test_position_goes_into_the_checkpoint_and_another_seed_is_refused():
    saved = states(seed=3, step=12).state_dict()
    assert {**saved, "lost": None} == {"seed": 3, "step": 12, "lost": None}
    states(seed=3).load_state_dict(saved)
    with pytest.raises(CheckpointError, match=r"Expected .* seed 3, got seed 4") as raised:
        states(seed=4).load_state_dict(saved)
    assert "\n" not in str(raised.value)
