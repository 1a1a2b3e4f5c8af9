"""A whole training in plain Lightning: parts of a user's own, no YAML, no folder of lyapnet's."""

import lightning
import pytest
import torch
from lightning.pytorch.loggers import CSVLogger
from torch.utils.data import DataLoader

import lyapnet
from lyapnet.evaluation import evaluate
from tests.probes.own_parts import AbsoluteProgram, CostOfValidations, ListLogger, Network, Pendulum

pytestmark = [
    pytest.mark.filterwarnings(f"ignore:{message}")
    for message in (".*does not have many workers", ".*smaller than the logging interval", ".*LeafSpec")
]
EPOCHS, STEPS = 3, 4


@pytest.fixture(scope="module")
def problem():
    torch.set_default_dtype(torch.float64)
    cost = lyapnet.QuadraticCost([[2.0, 0.0], [0.0, 1.0]], [[1.0]], [[2.0, 0.0], [0.0, 1.0]])
    states, horizon = lyapnet.Box([-0.5, -0.5], [0.5, 0.5]), lyapnet.Horizon(20, 0.1)
    return lyapnet.Problem(Pendulum(), cost, lyapnet.Unbounded(), states, horizon)


@pytest.fixture(scope="module")
def trained(problem, tmp_path_factory):
    """(trainer, module, its own logger, its own callback) after a training with Lightning's defaults."""
    torch.manual_seed(0)
    program, optimizer = (
        AbsoluteProgram(constraint=0.01, trajectory_cost=1),
        lyapnet.OptimizerOptions(learning_rate=0.05),
    )
    module = lyapnet.ValueModule(problem, Network(), program, optimizer=optimizer)
    own, callback, folder = ListLogger(), CostOfValidations(), tmp_path_factory.mktemp("plain")
    trainer = lightning.Trainer(
        max_epochs=EPOCHS, logger=[CSVLogger(folder), own], callbacks=[callback], accelerator="cpu",
        enable_progress_bar=False, enable_model_summary=False,
    )  # fmt: skip
    trainer.fit(module, lyapnet.InitialStateDataModule(problem, 8, 8, steps_per_epoch=STEPS))
    return trainer, module, own, callback


@pytest.mark.gate
def test_curves_reach_any_logger(trained):
    _, _, logger, _ = trained
    assert [step for step, _ in logger.metrics["loss/train"]] == list(range(1, EPOCHS * STEPS + 1))
    assert [step for step, _ in logger.metrics["trajectory_cost/val"]] == [0, STEPS, 2 * STEPS, 3 * STEPS]
    rates = [rate for _, rate in logger.metrics["learning_rate"]]
    assert rates == sorted(rates, reverse=True)
    assert rates[-1] < 0.05 * rates[0], "the schedule ends with the training"
    assert {"term/constraint", "term/terminal", "gradient_norm", "constraint_loss/val"} <= logger.metrics.keys()


def test_the_training_minimises_the_cost(trained):
    _, _, logger, callback = trained
    (_, first), *_, (_, last) = logger.metrics["trajectory_cost/val"]
    assert last < 0.9 * first
    assert callback.costs == [cost for _, cost in logger.metrics["trajectory_cost/val"]][1:]


def test_what_was_trained_is_a_controller(trained, problem):
    controller = lyapnet.Controller(problem, trained[1].V, program=trained[1].program)
    x0 = [[0.3, 0.0], [-0.1, 0.2]]
    assert controller.policy(0.0, x0).shape == (2, 1)
    assert controller.rollout(x0).x.shape == (21, 2, 2)
    result = evaluate(controller, 16, optimum=False)
    states = trained[0].datamodule.validation_batch()
    assert controller.rollout(states).cost.mean() == pytest.approx(trained[3].costs[-1])
    assert result["cost_mean"] > 0


def test_lightnings_own_checkpoint_is_read_again(trained, problem):
    trainer, module, _, _ = trained
    path = trainer.checkpoint_callback.best_model_path
    parts = {"problem": problem, "V": Network(), "program": module.program}
    again = lyapnet.ValueModule.load_from_checkpoint(path, **parts)
    x = torch.randn(5, 2)
    assert torch.equal(again.V(torch.tensor(0.2), x), module.V(torch.tensor(0.2), x))
    assert not torch.equal(Network()(torch.tensor(0.2), x), module.V(torch.tensor(0.2), x))


@pytest.mark.gate
def test_loaders_serve_as_well_as_a_data_module(problem):
    module = lyapnet.ValueModule(problem, Network(), lyapnet.ValueProgram(trajectory_cost=1))
    states = DataLoader([problem.initial_states.sample(4)] * 2, batch_size=None)
    logger = ListLogger()
    trainer = lightning.Trainer(
        max_epochs=1, logger=logger, accelerator="cpu", enable_progress_bar=False, enable_model_summary=False,
        enable_checkpointing=False,
    )  # fmt: skip
    trainer.fit(module, states, states)
    assert [step for step, _ in logger.metrics["trajectory_cost/val"]] == [2]


def test_parts_that_break_their_contract_are_refused(problem):
    class Detached(Pendulum):
        def f(self, x):
            return super().f(x).detach()

    broken = problem.replaced(system=Detached())
    with pytest.raises(lyapnet.LyapnetError, match=r"Detached\.f\(x\)"):
        lyapnet.ValueModule(broken, Network(), lyapnet.ValueProgram())


class Inner(Network):
    """A network with a part whose name the module uses too."""

    def __init__(self):
        super().__init__()
        self.rollout = torch.nn.Linear(1, 1)


def test_weights_keep_their_names_whatever_a_network_calls_its_parts(problem):
    module = lyapnet.ValueModule(problem, Inner(), lyapnet.ValueProgram())
    stored = module.state_dict()
    assert stored.keys() == {f"V.{name}" for name in module.V.state_dict()}
    again = lyapnet.ValueModule(problem, Inner(), lyapnet.ValueProgram())
    again.load_state_dict(stored)
    assert torch.equal(again.V.rollout.weight, module.V.rollout.weight)
    with pytest.raises(lyapnet.LyapnetError, match=r"no weights V\.further"):
        again.load_state_dict({**stored, "V.further": torch.zeros(1)})
