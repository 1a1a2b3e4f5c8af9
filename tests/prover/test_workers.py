"""Workers: the same proof as by one process, and an error of one line if they are killed."""

import os
import signal
import socket
import threading

import pytest
import torch

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.claims.least_cost import RiseCondition
from lyapnet.prover import proof
from lyapnet.prover.boxes import Boxes, root_box
from lyapnet.prover.branch_and_bound import Budget, Question
from lyapnet.prover.condition import DecreaseCondition, bounded_condition
from lyapnet.prover.proof import ProvedLevel, identify_bounds, prove, remake_question
from lyapnet.prover.workers import workers_for_boxes
from tests.claims.planted import domain, loop, riccati
from tests.claims.test_least_cost import problem


class InHalves(Question):
    """Cut boxes wider than the level across their widest axis; their keys are the id of the process."""

    level = 0.3

    def find_undecided(self, boxes):
        widths = boxes.upper - boxes.lower
        chosen = widths.amax(-1) > self.level
        boxes = boxes._replace(key=torch.full_like(boxes.key, float(os.getpid())))
        return boxes[chosen], widths[chosen].argmax(-1)


def chunks():
    box = root_box(torch.zeros(2), torch.ones(2))
    return [box, box.joined(box), Boxes(*(part[:0] for part in box))]


def test_workers_are_other_processes_that_see_the_level_as_it_is():
    question = InHalves()
    with workers_for_boxes(question, 2) as run:
        (one, axes), (two, _), (none, _) = run(question.find_undecided, chunks())
        assert [len(boxes.key) for boxes in (one, two, none)] == [1, 2, 0]
        assert axes.tolist() == [0]
        assert float(one.key) != os.getpid()
        question.level = 2.0
        assert [len(boxes.key) for boxes, _ in run(question.find_undecided, chunks())] == [0, 0, 0]
    with workers_for_boxes(question, 1) as run:
        assert run is map


@pytest.mark.parametrize("workers", [1, 2])
def test_a_proof_is_the_same_with_workers(workers):
    proof = prove(DecreaseCondition(loop(riccati()), 0.9, 0.02), domain(), 10.0, Budget(30, chunk=64, workers=workers))
    assert proof.verdict == "certified"
    assert proof.remaining_volume == 0


def test_a_violation_is_found_with_workers():
    proof = prove(DecreaseCondition(loop(0.5 * riccati()), 0.9, 0.02), domain(), 10.0, Budget(30, workers=2))
    assert proof.verdict == "falsified"


def test_a_worker_that_is_killed_is_one_line():
    class Killed(InHalves):
        def find_undecided(self, boxes):
            os.kill(os.getpid(), signal.SIGKILL)

    question, before = Killed(), threading.active_count()
    with (
        pytest.raises(UsageError, match="Expected all workers to finish, got one that was killed"),
        workers_for_boxes(question, 2) as run,
    ):
        list(run(question.find_undecided, chunks()))
    assert threading.active_count() <= before + 2, "the threads of a pool ended with it"


@pytest.mark.gate
def test_another_machine_bounds_the_same_or_nothing():
    """The condition is pickled and traced again: the same boxes to the last bit, or an error."""
    pickle = pytest.importorskip("cloudpickle")
    condition = DecreaseCondition(loop(riccati()), 0.9, 0.02)
    bounded = bounded_condition(condition, domain(), 1, torch.inf)
    question = ProvedLevel(condition, bounded, torch.inf, True)
    there = remake_question(pickle.loads(pickle.dumps(condition)), domain(), 1, torch.inf, identify_bounds(bounded))
    boxes, rounds = root_box(*domain()), 0
    while len(boxes.key):
        rounds += 1
        (here, axis), (other, same) = question.find_undecided(boxes), there.find_undecided(boxes)
        assert torch.equal(here.lower, other.lower)
        assert torch.equal(axis, same)
        boxes = here.halves(axis) if len(axis) else here
    assert rounds > 3
    function, sources, torchs = identify_bounds(bounded)
    for other in (("0" * 64, sources, torchs), (function, "0" * 64, torchs), (function, sources, "1.0")):
        with pytest.raises(UsageError, match="Expected the same condition, lyapnet and torch on each machine"):
            remake_question(condition, domain(), 1, torch.inf, other)


@pytest.mark.gate
def test_a_cluster_proves_the_same():
    pytest.importorskip("ray")
    condition = DecreaseCondition(loop(riccati()), 0.9, 0.02)
    proof = prove(condition, domain(), 10.0, Budget(100, chunk=64, workers=2, ray="local"))
    alone = prove(condition, domain(), 10.0, Budget(100, chunk=64, workers=2))
    assert (proof.verdict, proof.boxes, proof.level) == (alone.verdict, alone.boxes, alone.level)
    assert proof.verdict == "certified"


@pytest.mark.gate
def test_what_a_cluster_cannot_do_is_one_line(monkeypatch):
    """Too many workers; other code there; and the handler of SIGTERM stays."""
    pytest.importorskip("ray")
    condition, handler = RiseCondition(loop(riccati()).requires_grad_(False), 0.9, 0.02, problem()), lambda *_: None
    before = signal.signal(signal.SIGTERM, handler)
    try:
        with pytest.raises(UsageError, match="cores of the cluster, got --workers 5000; ask for fewer"):
            prove(condition, domain(), 1.0, Budget(60, workers=5000, ray="local"))
        monkeypatch.setattr(proof, "identify_bounds", lambda bounded: ("other", "code", "here"))
        with pytest.raises(UsageError, match="Expected the same condition, lyapnet and torch on each machine"):
            prove(condition, domain(), 1.0, Budget(60, ray="local"))
        assert signal.getsignal(signal.SIGTERM) is handler
    finally:
        signal.signal(signal.SIGTERM, before)


def test_a_cluster_that_does_not_exist_is_an_error_at_once():
    pytest.importorskip("ray")
    with pytest.raises(UsageError, match="Expected a Ray cluster as auto, local or ray://host:port"):
        prove(DecreaseCondition(loop(riccati()), 0.9, 0.02), domain(), 10.0, Budget(30, ray="ray://host:abc"))
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"
    with pytest.raises(UsageError, match="Connection refused; run ray start"):
        prove(DecreaseCondition(loop(riccati()), 0.9, 0.02), domain(), 10.0, Budget(30, ray=address))


@pytest.mark.parametrize("device", ["xyz", "meta", "cpu:7", "cpu:0", "cuda:99", "mps:3", "", "cpu cuda"])
def test_a_device_that_does_not_compute_is_one_line(device):
    with pytest.raises(UsageError, match=f"Expected a device that computes here, cpu or cuda, got '{device}'"):
        Budget(device=device)
    with pytest.raises(UsageError, match="Expected a device that computes here"):
        lyapnet.load("zoo:double_integrator", device=device)
    assert Budget(device="cpu").device == "cpu"


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")
def test_a_gpu_finds_the_same_bounds_and_the_same_proof():
    condition = DecreaseCondition(loop(riccati()), 0.9, 0.02)
    bounded = bounded_condition(condition, domain(), 3)
    lower, upper = (side.expand(500, 3) for side in domain())
    lower = lower + (upper - lower) * 0.9 * torch.rand(500, 3)
    upper = lower + 0.1
    with (device := torch.device("cuda")):
        there = bounded.on(device).bounds(lower.to(device), upper.to(device))
    for near, far in zip(bounded.bounds(lower, upper), there, strict=True):
        torch.testing.assert_close(torch.stack(near), torch.stack(far).cpu(), rtol=1e-10, atol=1e-10)
    assert prove(condition, domain(), 10.0, Budget(60, device="cuda")).verdict == "certified"
    with pytest.raises(UsageError, match="Expected one worker on cuda, got 2"):
        Budget(device="cuda", workers=2)
