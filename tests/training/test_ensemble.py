"""Several seeds side by side: each member is the run of its seed, and what a user sees of them."""

import dataclasses
import json
import math
import os
import signal
from contextlib import suppress

import pytest
import torch
from matplotlib.figure import Figure
from torch.testing import assert_close

import lyapnet
from lyapnet.base.errors import CheckpointError, DivergenceError, UntraceableError
from lyapnet.cli import main
from lyapnet.evaluation.states import StateTable
from lyapnet.experiment.checkpoint import read_checkpoint
from lyapnet.experiment.config import load_config
from lyapnet.loop.rollout import Rollout
from lyapnet.task.sets import Box
from lyapnet.task.systems import DoubleIntegrator
from lyapnet.training import figure_logger
from lyapnet.training.build import build_module
from lyapnet.training.data import EnsembleDataModule, InitialStateDataModule
from lyapnet.training.progress import describe_validation_states, mean_and_range
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.networks import FCN, NETWORKS
from tests.problems import problem_of
from tests.runs import MEASURED_TIME, SMALL, Desk, differences, logged, values, without_figures

SEED, SEEDS, STEPS = 3, 3, 6
DISCRETE = {"gradient": "discrete", "compile": "off"}
POINTWISE = {"weight": 1.0, "points": 8}  # its points are draws as well: of the seed, and again after an interruption
TRAINING = {**SMALL["training"], "iterations": STEPS, "validate_every": 3}
FOLDERS = [f"seed_{SEED + k}" for k in range(SEEDS)]


def desk_of(folder, **changes):
    folder.mkdir(exist_ok=True)
    return Desk(
        folder,
        **{"seed": SEED, "seeds": SEEDS, "rollout": DISCRETE, "training": TRAINING, "pointwise": POINTWISE, **changes},
    )


def config_of(tmp_path, *overrides):
    return load_config(desk_of(tmp_path).folder / "experiment.yaml", overrides)


def blank_figures():
    """Drawing takes most of the time of a short run."""
    figure_logger.figures_of = lambda learner: {"first seed": Figure()} if learner.seed == SEED else {}


@pytest.fixture(scope="module")
def ensemble(tmp_path_factory):
    """A finished run of three seeds."""
    desk = desk_of(tmp_path_factory.mktemp("ensemble"))
    status, _, errors = desk.train(prepare=blank_figures)
    assert (status, errors) == (0, "")
    return desk


@pytest.fixture(scope="module")
def single(tmp_path_factory):
    """The run of the second seed alone."""
    desk = desk_of(tmp_path_factory.mktemp("single"), seed=SEED + 1, seeds=1)
    assert desk.train(prepare=without_figures)[0] == 0
    return desk


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """An ensemble, built once."""
    return build_module(config_of(tmp_path_factory.mktemp("built")))


@pytest.fixture
def module(built):
    """The ensemble as it was built, with gradients of zero."""
    weights = [p.detach().clone() for p in built.parameters()]
    for p in built.parameters():
        p.grad = torch.zeros_like(p)
    yield built
    for p, weight in zip(built.parameters(), weights, strict=True):
        p.data.copy_(weight)


# Each member is the run of its seed


def distance(one, other):
    """The largest relative difference between the weights of two checkpoints."""
    weights, others = (read_checkpoint(path)["state_dict"] for path in (one, other))
    assert weights.keys() == others.keys()
    return max(float((weights[key] - others[key]).abs().max() / others[key].abs().max()) for key in weights)


@pytest.mark.gate
def test_member_is_the_run_of_its_seed(ensemble, single):
    alone = single.best()
    assert distance(ensemble.best("seed_4"), alone) == 0
    assert read_checkpoint(ensemble.best("seed_4"))["lyapnet"] == read_checkpoint(alone)["lyapnet"]
    for wrong in ("seed_3", "seed_5"):
        assert distance(ensemble.best(wrong), alone) > 1e-3


@pytest.mark.gate
def test_curves_of_a_member_are_those_of_its_run(ensemble, single):
    member, alone = logged(ensemble.run / "seed_4"), logged(single.run)
    pictures = {tag for tag in logged(ensemble.run / "seed_3") if tag not in member}
    assert pictures == {"first seed"}
    assert member.keys() == alone.keys()
    for tag in (
        "loss/train",
        "term/pointwise",
        "gradient_norm",
        "trajectory_cost/val",
        "optimality_gap/val",
        "hp/cost_mean",
    ):
        curve, other = values(ensemble.run / "seed_4", tag), values(single.run, tag)
        assert curve == pytest.approx(other, rel=1e-6)
        assert values(ensemble.run / "seed_3", tag) != pytest.approx(other, rel=1e-6), "another seed, another curve"


@pytest.mark.parametrize("algorithm", ["norm", "value"])
def test_gradients_are_clipped_member_by_member(algorithm, module):
    gradients = {}
    for scale, member in zip((1e-3, 1.0, 1e3), module.members, strict=True):
        for p in member.V.parameters():
            p.grad = scale * torch.ones_like(p)
        expected = [p.detach().clone().requires_grad_() for p in member.V.parameters()]
        for p in expected:
            p.grad = scale * torch.ones_like(p)
        clip = {"norm": torch.nn.utils.clip_grad_norm_, "value": torch.nn.utils.clip_grad_value_}[algorithm]
        clip(expected, 0.5)
        gradients[member] = [p.grad for p in expected]
    module.configure_gradient_clipping(torch.optim.SGD(module.parameters()), 0.5, algorithm)
    for member, expected in gradients.items():
        assert all(torch.equal(p.grad, e) for p, e in zip(member.V.parameters(), expected, strict=True))
    small, large = (next(module.members[k].V.parameters()).grad.flatten()[0] for k in (0, 2))
    assert small == 1e-3, "which the norm of all would have shrunk"
    assert large < 1e3


def test_batches_are_those_of_the_seeds():
    box = Box([-1.0, 0.0], [1.0, 2.0])
    problem = problem_of(DoubleIntegrator(), initial_states=box)
    together = EnsembleDataModule(problem, 4, 5, SEED, SEEDS)
    for draw in (lambda data: data.batch(7), lambda data: data.validation_batch()):
        batch = draw(together)
        for k in range(SEEDS):
            assert torch.equal(batch[k], draw(InitialStateDataModule(problem, 4, 5, SEED + k)))
        assert not torch.equal(batch[0], batch[1])


@pytest.mark.gate
def test_ensemble_of_a_checkpoint_starts_from_its_weights(ensemble, tmp_path):
    source, desk = ensemble.best("seed_5"), desk_of(tmp_path)
    assert desk.train("--finetune", str(source), "training.iterations=1", prepare=without_figures)[0] == 0
    firsts = [values(desk.run / folder, "trajectory_cost/val")[0] for folder in FOLDERS]
    expected = [float(controller_cost(source, SEED + k)) for k in range(SEEDS)]
    assert firsts == pytest.approx(expected, rel=1e-6)
    assert len(set(firsts)) == SEEDS, "each has states of its own"
    assert distance(desk.best("seed_3"), desk.best("seed_4")) > 1e-6


def controller_cost(path, seed):
    """The mean cost of a checkpoint's controller on a seed's validation states."""
    controller = lyapnet.load(path)
    data = InitialStateDataModule(controller.problem, 1, SMALL["evaluation"]["validation_states"], seed)
    return controller.rollout(data.validation_batch()).cost.mean()


# What a user sees


@pytest.mark.gate
def test_folder_of_an_ensemble(ensemble):
    assert {path.name for path in ensemble.run.iterdir()} == {
        ".lock", "config.yaml", "run.json", "evaluation.json", "checkpoints", *FOLDERS
    }  # fmt: skip
    assert [path.name for path in (ensemble.run / "checkpoints").iterdir()] == ["last.ckpt"]
    assert load_config(ensemble.run / "config.yaml").seeds == SEEDS
    steps = [step for step, _ in logged(ensemble.run / "seed_5")["loss/train"]]
    assert steps == list(range(1, STEPS + 1))


@pytest.mark.gate
def test_best_checkpoint_of_a_member_is_an_ordinary_one(ensemble, tmp_path, capsys):
    controller = lyapnet.load(ensemble.best("seed_5"))
    assert (controller.config.seed, controller.config.seeds) == (SEED + 2, 1)
    assert main(["evaluate", str(ensemble.best("seed_5")), "--samples", "6", "--seed", "5", "--json"]) == 0
    evaluation = json.loads(capsys.readouterr().out)
    stored = json.loads((ensemble.run / "evaluation.json").read_text())
    assert evaluation == stored["seeds"][2]
    assert evaluation != stored["seeds"][1]
    desk = desk_of(tmp_path, seed=0, seeds=1)
    assert (
        desk.train("--finetune", str(ensemble.best("seed_5")), "training.iterations=1", prepare=without_figures)[0] == 0
    )


@pytest.mark.gate
def test_checkpoint_of_all_seeds_is_refused_where_one_is_needed(ensemble):
    with pytest.raises(CheckpointError, match=r"holds several; use .*best.ckpt"):
        lyapnet.load(ensemble.last)


@pytest.mark.gate
def test_evaluation_has_the_mean_and_the_spread(ensemble):
    stored = json.loads((ensemble.run / "evaluation.json").read_text())
    assert [one["seed"] for one in stored["seeds"]] == [SEED + k for k in range(SEEDS)]
    costs = torch.tensor([one["cost_mean"] for one in stored["seeds"]])
    assert stored["mean"]["cost_mean"] == pytest.approx(float(costs.mean()))
    assert stored["spread"]["cost_mean"] == pytest.approx(float(costs.std()))
    assert stored["mean"].keys() == stored["spread"].keys()
    assert not {"seed", "samples"} & stored["mean"].keys()


@pytest.mark.gate
def test_terminal_shows_ranges_over_the_seeds(ensemble, single):
    shown, alone = ensemble.output.read_text(), single.output.read_text()
    (line,) = [line for line in shown.splitlines() if line.startswith("step 3/")]
    costs = [values(ensemble.run / folder, "trajectory_cost/val")[3] for folder in FOLDERS]
    assert f"cost {sum(costs) / SEEDS:.4g} ({min(costs):.4g} – {max(costs):.4g})" in line
    for text in ("mean ± spread", "3 seeds, 6 unseen", "seed_3/checkpoints/best.ckpt"):
        assert text in shown
        assert text not in alone
    assert "(" not in next(line for line in alone.splitlines() if line.startswith("step 3/"))


def test_a_measure_over_seeds():
    summaries = [{"cost": 1.0, "ratio": None}, {"cost": 4.0, "ratio": None}]
    assert mean_and_range(summaries, "cost", ".2f") == "2.50 (1.00 – 4.00)"
    assert mean_and_range(summaries[:1], "cost", ".2f") == "1.00"
    assert mean_and_range(summaries, "ratio", ".2f") == ""


def test_a_measure_that_fewer_states_have_says_how_many():
    def table(optima, has_goal=True):
        x, one = torch.ones(4, 2), torch.ones(4)
        optimum = torch.tensor(optima)
        return StateTable(x, one, one, optimum, one, one, one > 0, one > 0, one, x, one, has_goal=has_goal)

    some, every = [1.0, 1.0, math.nan, math.nan], [1.0] * 4
    said = "below: means over 8 validation states, the same at every step"
    assert describe_validation_states([table(every)] * 2) == said
    assert (
        describe_validation_states([table(some)] * 2)
        == f"{said}; cost/optimum over the 4 of them whose optimum is known"
    )
    assert "; regret over the 2 of them" in describe_validation_states([table(some, has_goal=False)])


# Interrupted, diverged, refused


@pytest.mark.gate
def test_interrupted_an_ensemble_goes_on_to_the_same_end(ensemble, tmp_path):
    desk = desk_of(tmp_path)
    process = desk.start(prepare=without_figures)
    desk.wait_for("step 3/", process)
    os.kill(process.pid, signal.SIGINT)
    status, _, errors = desk.end(process)
    assert status == 0
    assert "SIGINT" in errors
    assert 3 <= read_checkpoint(desk.last)["global_step"] < STEPS
    assert desk.train("--resume", "last", prepare=without_figures)[0] == 0
    assert not list(unequal(desk, ensemble))
    assert (desk.run / "evaluation.json").read_text() == (ensemble.run / "evaluation.json").read_text()


@pytest.mark.gate
def test_ensembles_of_other_seeds_end_differently(ensemble, tmp_path):
    """A twin: what the comparison can see."""
    desk = desk_of(tmp_path, seed=SEED + 10)
    assert desk.train(prepare=without_figures)[0] == 0
    different = set(unequal(desk, ensemble, FOLDERS[:0]))
    assert any(name.startswith("state_dict.members.2.V") for name in different)
    assert any(name.startswith("optimizer_states") for name in different)
    assert any("best_loss" in name for name in different)


def unequal(one, other, folders=FOLDERS):
    """What differs between two finished ensembles: checkpoints and curves, but for pictures and measured time."""
    last = [read_checkpoint(desk.last) for desk in (one, other)]
    yield from (name.removeprefix(".") for name in differences(*last))
    for folder in folders:
        yield from differences(*(read_checkpoint(desk.best(folder)) for desk in (one, other)), folder)
        curves, others = logged(one.run / folder), logged(other.run / folder)
        for tag in curves:
            if tag not in MEASURED_TIME and not tag.startswith("_hparams_") and curves[tag] != others[tag]:
                yield f"{folder}: {tag}"


@pytest.mark.parametrize("call", ["training_step", "validate_on", "on_before_optimizer_step"])
def test_divergence_names_the_seed(call, module):
    problem = module.members[0].problem
    x0 = problem.initial_states.center.expand(SEEDS, SMALL["training"]["batch_size"], -1).contiguous()
    arguments = {
        "training_step": (x0, 0),
        "validate_on": (x0,),
        "on_before_optimizer_step": (torch.optim.SGD(module.parameters()),),
    }[call]
    getattr(module, call)(*arguments)
    diverging = next(module.members[1].V.parameters())
    diverging.data.fill_(math.nan)
    diverging.grad.fill_(math.nan)
    with pytest.raises(DivergenceError, match=r"^Iteration 0, seed 4: Expected a finite"):
        getattr(module, call)(*arguments)


@pytest.mark.parametrize(
    ("overrides", "named"),
    [
        (("trainer.devices=2",), "trainer.devices=1"),
        (("seeds=0",), "seeds ≥ 1"),
    ],
)
def test_what_seeds_cannot_do_is_refused_before_there_is_a_folder(overrides, named, tmp_path, capsys, monkeypatch):
    desk = desk_of(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert main(["train", "--config", "experiment.yaml", *overrides]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert named in message
    assert not (desk.folder / "logs").exists()


class RandomFeatures(FCN):
    """A network with more of the seed in it than its weights."""

    def __init__(self, scaling, hidden=(4,)):
        super().__init__(scaling, hidden)
        self.register_buffer("frequencies", torch.randn(3))


class Branching(ValueFunction):
    """A network whose control flow depends on values."""

    def __init__(self, scaling, hidden=(4,)):
        super().__init__()
        self.inner = FCN(scaling, hidden)

    def forward(self, t, x):
        return self.inner(t, x) if x.sum() < 1e9 else x.sum(-1)


@pytest.mark.parametrize("network", [RandomFeatures, Branching])
def test_networks_with_more_of_the_seed_in_them_than_weights(network, tmp_path, monkeypatch):
    """And those whose control flow depends on values: each member is a closed loop of its own."""
    monkeypatch.setitem(NETWORKS, "fcn", network)
    config = config_of(tmp_path, "network.name=fcn", "network.hidden=[4]", "rollout.compile=auto")
    module, alone = (build_module(dataclasses.replace(config, **own)) for own in ({}, {"seed": SEED + 1, "seeds": 1}))
    x0 = torch.stack([module.members[0].problem.initial_states.sample(4) for _ in range(SEEDS)])
    with suppress(UntraceableError):
        module.compile_for(4)
    first, second, *_ = (
        member.rollout(own) for member, own in zip(module.members, module.states_of_each(x0), strict=True)
    )
    assert_close(second.cost, alone.rollout(x0[1]).cost, rtol=1e-9, atol=0)
    assert not torch.allclose(second.cost, first.cost)


class Frozen(FCN):
    """A network with a tensor that no buffer holds, so that a trace keeps it as it is."""

    def __init__(self, scaling, hidden=(4,)):
        super().__init__(scaling, hidden)
        self.slopes = torch.randn(2)

    def forward(self, t, x):
        return super().forward(t, x * self.slopes)

    value_and_state_gradient = ValueFunction.value_and_state_gradient


@pytest.mark.parametrize(("network", "shared"), [(FCN, True), (RandomFeatures, True), (Frozen, False)])
def test_members_share_code_where_they_are_one_function_of_their_tensors(network, shared, tmp_path, monkeypatch):
    monkeypatch.setitem(NETWORKS, "fcn", network)
    module = build_module(config_of(tmp_path, "network.name=fcn", "network.hidden=[4]"))
    module.compile_for(4)
    x0 = torch.stack([module.members[0].problem.initial_states.sample(4) for _ in range(SEEDS)])
    first, second, _ = (member.rollout.discrete.routines(x0[0]) for member in module.members)
    assert (first is second) is shared
    for member, own in zip(module.members, module.states_of_each(x0), strict=True):
        trajectory = member.rollout(own)
        written = Rollout(member.problem, member.rollout.closed_loop.policy, gradient="backprop")(own)
        assert_close(trajectory.x, written.x, rtol=1e-9, atol=1e-9)
        assert_close(slopes_of(member, trajectory), slopes_of(member, written), rtol=1e-8, atol=1e-8)


def slopes_of(member, trajectory):
    slopes = torch.autograd.grad(trajectory.cost.sum(), [*member.V.parameters()], materialize_grads=True)
    return torch.cat([slope.flatten() for slope in slopes])
