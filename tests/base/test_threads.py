"""Work on several threads: results in their order, the same for any number of threads, and its seconds counted."""

import threading
import time

import pytest
import torch

from lyapnet.base import threads as module
from lyapnet.base.threads import in_threads, seconds_of_work, size_of_parts, use_threads


@pytest.fixture
def threads(monkeypatch):
    """Sets the number of threads that torch says it has."""
    monkeypatch.setattr(module, "_of_programs", None)
    return lambda count: monkeypatch.setattr(torch, "get_num_threads", lambda: count)


def work(seconds):
    """Spin for some seconds of CPU; the thread that did."""
    end = time.thread_time() + seconds
    while time.thread_time() < end:
        pass
    return threading.current_thread()


def test_results_are_in_order_and_from_other_threads(threads):
    threads(3)
    assert in_threads(lambda k: k**2, range(20)) == [k**2 for k in range(20)]
    assert threading.current_thread() not in in_threads(lambda k: work(0.001), range(6))
    threads(1)
    assert {*in_threads(lambda k: work(0.001), range(6))} == {threading.current_thread()}


def test_a_part_that_is_divided_again_stays_on_its_thread(threads):
    threads(2)

    def divide(k):
        return threading.current_thread(), in_threads(lambda j: work(0.001), range(3))

    for own, others in in_threads(divide, range(8)):  # would wait for ever for a free thread
        assert {*others} == {own}


def test_gradients_are_not_recorded(threads):
    threads(2)
    slope = torch.ones(3, requires_grad=True)
    assert not any(each.requires_grad for each in in_threads(lambda k: k * slope, range(4)))


def test_an_error_of_a_part_is_raised(threads):
    threads(2)
    with pytest.raises(ZeroDivisionError):
        in_threads(lambda k: 1 / (k - 3), range(6))


@pytest.mark.parametrize("count", [1, 2])
def test_the_work_of_parts_counts_once_for_all_threads(threads, count):
    threads(count)
    began = seconds_of_work()
    in_threads(lambda k: work(0.05), range(4))
    assert 0.2 / count <= seconds_of_work() - began < 0.4 / count
    began, before = seconds_of_work(), time.monotonic()
    time.sleep(0.2)
    assert time.monotonic() - before > 0.19 > seconds_of_work() - began


def test_parts_are_equally_large():
    sizes = {0: 0, 1: 1, 12: 12, 16: 16, 24: 24, 32: 16, 37: 37, 48: 16, 50: 25, 64: 16}
    assert {rows: size_of_parts(rows, 16) for rows in sizes} == sizes


@pytest.mark.parametrize(("count", "of_torch", "of_programs"), [(None, 1, 3), (1, 1, 1), (2, 2, 2)])
def test_by_default_programs_have_all_cores_and_torch_one(count, of_torch, of_programs, monkeypatch):
    monkeypatch.setattr(module, "CORES", 3)
    monkeypatch.setattr(module, "_of_programs", None)
    before = torch.get_num_threads()
    try:
        use_threads(count)
        assert torch.get_num_threads() == of_torch
        at_once = threading.Barrier(of_programs, timeout=60)
        found = in_threads(lambda k: at_once.wait() * 0 + threading.get_ident(), range(of_programs))
        assert len({*found}) == of_programs
    finally:
        torch.set_num_threads(before)
