"""A claim from a user's module: certified, refuted where it is false, shown as a table and written as a report."""

import importlib
import json
import re
import subprocess
import sys

import pytest
import torch

import lyapnet
from lyapnet.base.errors import UsageError
from tests.claims.planted import problem, riccati, stationary
from tests.pages import ROOT

PAGE = (ROOT / "docs" / "from_python.md").read_text(encoding="utf-8")
(MODULE,) = re.findall(r"```python\n(# effort\.py.*?)```", PAGE, flags=re.DOTALL)


@pytest.fixture(scope="module")
def effort(tmp_path_factory):
    """The module of docs/from_python.md, in a folder of its own."""
    folder = tmp_path_factory.mktemp("own_claim")
    (folder / "effort.py").write_text(MODULE, encoding="utf-8")
    torch.set_default_dtype(torch.float64)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        yield importlib.import_module("effort")


@pytest.fixture
def controller():
    return lyapnet.Controller(problem(), stationary(riccati()))


def largest_effort(controller):
    """max |u| over X₀: u is linear, so that a corner has it."""
    return float(controller.policy(0.0, controller.initial_states.corners()).abs().max())


@pytest.mark.gate
def test_a_true_claim_is_certified_and_its_false_twin_is_not(effort, controller):
    largest = largest_effort(controller)
    certificate = lyapnet.certify(controller, effort.Effort(limit=1.01 * largest), budget=30)
    assert certificate.verdict == "certified"
    assert certificate.result["remaining_volume"] == 0
    twin = lyapnet.certify(controller, effort.Effort(limit=0.99 * largest), budget=30)
    assert twin.verdict == "falsified"
    found = twin.result["counterexample"]
    assert float(controller.policy(found["t"], torch.tensor(found["x"])).abs().max()) > 0.99 * largest
    assert "it fails by" in twin.verdict_text()


def test_where_bounds_have_no_time_it_is_unknown(effort, controller):
    claim = effort.Effort(limit=largest_effort(controller))  # c = 0 at a corner
    certificate = lyapnet.certify(controller, claim, budget=lyapnet.Budget(20, boxes=50))
    assert certificate.verdict == "unknown"
    assert "seconds spent" in certificate.result["reason"]


def test_its_set_is_an_option(effort, controller):
    largest = largest_effort(controller)
    inside = effort.Effort(limit=0.99 * largest, states=[[-0.9, -0.6], [0.9, 0.6]])
    assert lyapnet.certify(controller, inside, budget=30).verdict == "certified"


@pytest.mark.gate
def test_workers_prove_the_same(effort, controller):
    claim = effort.Effort(limit=1.01 * largest_effort(controller))
    certificate = lyapnet.certify(controller, claim, budget=lyapnet.Budget(60, workers=2))
    assert certificate.verdict == "certified"


@pytest.mark.gate
def test_it_is_shown_and_reported_like_any_other(effort, controller, tmp_path):
    certificate = lyapnet.certify(controller, effort.Effort(limit=20), budget=30, keep=tmp_path / "kept.proof")
    assert "effort: certified" in str(certificate)
    assert "share of [0, T] × D undecided" in str(certificate)
    written = certificate.write(tmp_path / "report")
    assert {path.name for path in written} == {"claim.png", "report.json", "report.md"}
    text = (tmp_path / "report" / "report.md").read_text(encoding="utf-8")
    assert "|u(t, x)| ≤ 20" in text
    assert "lyapnet.certify(controller, Effort(" in text
    content = json.loads((tmp_path / "report" / "report.json").read_text(encoding="utf-8"))
    assert content["options"]["limit"] == 20
    assert content["certificate"]["verdict"] == "certified"
    again = lyapnet.certify(controller, effort.Effort(limit=20), budget=30, keep=tmp_path / "kept.proof")
    assert again.verdict == "certified"
    with pytest.raises(UsageError):  # the proof of another claim
        lyapnet.certify(controller, effort.Effort(limit=21), budget=30, keep=tmp_path / "kept.proof")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"limit": -1}, "Expected limit > 0, got -1; give it in units of u."),
        ({"limit": "a"}, "Expected limit as a number, got 'a'; give it in units of u."),
        ({"states": "-1:1"}, "Expected states as a lyapnet.Box"),
    ],
)
def test_its_options_are_checked(effort, options, message):
    with pytest.raises(UsageError, match=re.escape(message)):
        effort.Effort(**options)


def test_rules_hold_in_a_module_whose_annotations_are_texts(effort, tmp_path, monkeypatch):
    (tmp_path / "late.py").write_text("from __future__ import annotations\n" + MODULE, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    late = importlib.import_module("late")
    for wrong in (-5, True, None, "5"):
        with pytest.raises(UsageError, match="Expected limit"):
            late.Effort(limit=wrong)


def test_a_set_of_other_dimension_is_refused(effort, controller):
    with pytest.raises(UsageError, match="Expected a set of 2 states, got 1"):
        lyapnet.certify(controller, effort.Effort(limit=50, states=[[-1], [1]]))


def test_a_v_that_declares_another_gradient_is_refused(controller):
    class Flat(type(controller.V)):
        def value_and_state_gradient(self, t, x):
            value, slope = super().value_and_state_gradient(t, x)
            return value, 0 * slope

    controller.V.__class__ = Flat

    class Slope(lyapnet.Everywhere):
        kind = "slope"

        def margin(self, loop, t, x):
            return (loop.V.value_and_state_gradient(t, x)[1] ** 2).sum(-1) - 1e-6

        def in_words(self):
            return "V is flat."

        def in_formulas(self):
            return ["V_x = 0"]

    with pytest.raises(UsageError, match="Expected a V whose gradient is its derivative"):
        lyapnet.certify(controller, Slope(), budget=10)


WRONG = {
    "certify('zoo:double_integrator', Funnel)": "Expected claims such as",
    "certify('zoo:double_integrator', 'sound')": "Expected claims such as",
    "certify(5, Sampled())": "Expected a controller or the path",
    "certify('zoo:double_integrator', Sampled(), budget=0)": "Expected budget",
    "certify('zoo:double_integrator', Sampled(), budget='60')": "Expected budget",
    "certify('zoo:double_integrator', Sampled(), seed=-1)": "Expected seed",
    "Funnel(disturbance={'velocity': '0.1'})": "Expected disturbance as numbers by name",
    "Funnel(disturbance='velocity=0.1')": "Expected disturbance as numbers by name",
    "Funnel(disturbance={'velocity': True})": "Expected disturbance as numbers by name",
    "Funnel(alpha=None)": "Expected alpha as a number",
    "Region(parameters={'mass': 1})": "Expected parameters as finite numbers",
    "Funnel(states=[[], []])": "Expected states",
}


@pytest.mark.gate
def test_what_is_no_claim_option_budget_or_seed_is_one_line():
    """In a process without the tests' own checks of types."""
    lines = ["from lyapnet import LyapnetError, Funnel, Region, Sampled, certify"]
    for call in WRONG:
        lines += ["try:", f"    {call}", "    print('accepted')", "except LyapnetError as error:", "    print(error)"]
    done = subprocess.run([sys.executable, "-c", "\n".join(lines)], capture_output=True, text=True, check=True)
    said = done.stdout.splitlines()
    assert len(said) == len(WRONG)
    assert [line for line, expected in zip(said, WRONG.values(), strict=True) if not line.startswith(expected)] == []
