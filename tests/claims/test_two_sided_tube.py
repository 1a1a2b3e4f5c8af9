"""Two-sided claims with tubes, against Riccati's solution; and a V that is no bound from below."""

import dataclasses
import json
import math
from functools import partial

import pytest
import torch

from lyapnet.base.errors import UsageError
from lyapnet.claims.certify import certify
from lyapnet.claims.from_below import LowerBoundCertificate
from lyapnet.claims.kinds import LowerBound, Tube
from lyapnet.claims.tubes import figures
from lyapnet.claims.tubes.certificate import TubeCertificate
from lyapnet.claims.two_sided import TwoSidedCertificate
from lyapnet.cli import main
from lyapnet.controller.controller import Controller
from lyapnet.prover import branch_and_bound
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.task.sets import Box
from tests.claims.planted import X0, riccati, stationary
from tests.claims.test_least_cost import optimum, problem
from tests.problems import Formula
from tests.runs import tiny_checkpoint

pytestmark = pytest.mark.usefixtures("one_closed_loop")

BETA, DELTA = 0.98, 0.005


def in_continuous_time():
    """Runge-Kutta steps, whose optima differ by 1e-9 from those of continuous time."""
    return problem().in_steps(method="rk4")


def both_sides(factor=1.0, beta=BETA, radius=None, states=None, budget=60):
    V = Formula(lambda t, x: factor * optimum(x) + 0 * t)
    below = LowerBound(beta=beta, delta=DELTA, states=states)
    return certify(Controller(in_continuous_time(), V), Tube(radius=radius), below, budget=budget)


@pytest.fixture(scope="module")
def riccatis():
    controller = Controller(in_continuous_time(), stationary(riccati()))
    return certify(controller, Tube(), LowerBound(beta=BETA, delta=DELTA))


def test_the_optimum_lies_between_and_the_tube_is_the_closer_side(riccatis):
    """The ratio comes from β and δT alone; a funnel would add α and δT from above."""
    result = riccatis.result
    assert result["verdict"] == "certified"
    assert result["holds_for"] == "every control"
    assert result["optima_between"] == 1
    mean = float(optimum(X0().sample(4000, torch.Generator().manual_seed(0))).mean())
    expected = mean / (BETA * mean - DELTA * problem().horizon.duration)
    assert expected - 1e-3 < result["certified_ratio"] < 1.01 * expected
    assert result["lower_fingerprint"] != result["fingerprint"]
    sides = riccatis.above, riccatis.below
    assert result["seconds"] == pytest.approx(sum(side.claim.seconds for side in sides))


@pytest.mark.gate
def test_a_law_that_is_dear_has_a_ratio_that_says_so(riccatis):
    """V = 0.8 J* bounds the optimum from below, and its law is not the optimal one."""
    result = both_sides(0.8, budget=30).result
    assert result["verdict"] == "certified"
    assert result["certified_ratio"] > 1.2 * riccatis.result["certified_ratio"]
    assert result["optima_between"] == 1


@pytest.fixture
def few_boxes(monkeypatch):
    """A budget of few boxes for each side."""
    monkeypatch.setattr(branch_and_bound, "Budget", partial(Budget, boxes=300))


@pytest.mark.gate
def test_a_value_that_is_too_high_is_no_bound():
    certificate = both_sides(1.1, budget=Budget(60, boxes=300))
    assert certificate.claim.verdict == "certified", "the tube itself is still certified"
    assert certificate.verdict != "certified"
    assert certificate.result["lower_reason"] is not None
    below, inside = certificate.below.claim, certificate.above.inside
    assert below.level < below.wanted
    assert bool((below.least_cost(inside.value) <= optimum(inside.x0)).all()), "the smaller bound is true"


@pytest.mark.gate
def test_one_of_the_sides_alone_is_no_certificate(riccatis):
    certificate = both_sides(radius=1e-9, budget=30)
    assert certificate.below.claim.verdict == "certified"
    assert certificate.verdict == certificate.claim.verdict != "certified"


def test_words_formulas_and_figure_are_about_both(riccatis):
    words, formulas = riccatis.in_words(), riccatis.in_formulas()
    assert "a tube, proved" in words
    assert "every control cost at least" in words
    assert any("min_u" in formula for formula in formulas)
    figure = riccatis.figure()
    shown = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    assert "proved: any control costs at least" in shown
    assert "from above / from below" in figure.get_suptitle()


def test_optima_of_the_first_states_alone_are_drawn_beside_both_bounds(riccatis):
    above = riccatis.above
    least = above.inside.low, "any control"
    figure = figures.tube(above.claim, above.controller, above.inside, above.inside.guaranteed[:3], "", least)
    (optima,) = [line for line in figure.axes[-1].lines if line.get_label() == "optimum of the steps of Δt"]
    assert len(optima.get_xdata()) == 3 < len(above.inside.x0)


@pytest.mark.gate
@pytest.mark.usefixtures("few_seconds_for_levels", "few_boxes")
def test_the_command(capsys, tmp_path):
    command = ["certify", "tube", str(tiny_checkpoint(tmp_path)), "--two-sided", "--beta", "0.8", "--delta", "0.5"]
    command += ["--set=-3:3,-4:4"]
    capsys.readouterr()
    main([*command, "--seconds", "60", "--json", "--report", str(tmp_path / "r")])
    result = json.loads(capsys.readouterr().out)
    assert result["kind"] == "tube"
    assert (result["beta"], result["delta"]) == (0.8, 0.5)
    assert result["lower_set"] == [[-3.0, -4.0], [3.0, 4.0]]
    assert {"mean_cost", "lower_level", "holds_for"} <= result.keys()
    assert "--two-sided" in (tmp_path / "r" / "report.md").read_text().rsplit("## To repeat it", 1)[1]


def test_a_tube_lies_in_a_set_that_is_as_large_on_each_side(riccatis):
    ranges = riccatis.claim.ranges
    lower, upper = ranges[..., 0].amin(0), ranges[..., 1].amax(0)
    around = dataclasses.replace(riccatis.below.claim, states=Box(lower, upper))
    assert riccatis.above.lies_in(around)
    for i in range(len(lower)):
        inwards = 1e-6 * torch.eye(len(lower), dtype=lower.dtype)[i]
        for smaller in (Box(lower + inwards, upper), Box(lower, upper - inwards)):
            assert not riccatis.above.lies_in(dataclasses.replace(around, states=smaller))


@pytest.mark.parametrize("option", ["--beta=0.9", "--delta=0.1", "--set=-1:1,-1:1"])
def test_what_is_of_the_other_side_is_refused_without_it(option, capsys):
    assert main(["certify", "tube", "zoo:double_integrator", option]) == 2
    name = option.partition("=")[0]
    assert f"Expected {name} with --two-sided, got it alone; add --two-sided" in capsys.readouterr().err


@pytest.mark.gate
def test_a_controller_that_leaves_the_set_is_not_compared_with_those_that_stay():
    """D just around X₀: the bound holds for controls that stay in D, and the law leaves D."""
    certificate = both_sides(states=[[-1.01, -0.71], [1.01, 0.71]], budget=30)
    assert certificate.below.claim.verdict == certificate.claim.verdict == "certified"
    assert not certificate.below.claim.everywhere
    assert certificate.result["tube_in_set"] is False
    assert certificate.verdict == "unknown"
    assert "the tube leaves D" in certificate.verdict_text()


def test_with_half_a_tube_the_states_that_have_one_are_compared(riccatis, monkeypatch):
    claim = riccatis.claim
    kept = claim.cells.lower[:, 0] >= 0
    half = dataclasses.replace(
        claim, cells=claim.cells[kept], cost=claim.cost[:, kept], slack=claim.slack[kept], ends=claim.ends[kept],
        volume_share=0.5,
    )  # fmt: skip
    tube = TubeCertificate(riccatis.controller, half, riccatis.options)
    certificate = TwoSidedCertificate(tube, riccatis.below, riccatis.options)
    assert certificate.verdict == "unknown"
    assert 400 < len(certificate.above.inside.value) < 600
    assert bool((certificate.above.inside.x0[:, 0] >= 0).all())
    assert certificate.result["certified_ratio"] == pytest.approx(riccatis.result["certified_ratio"], rel=0.05)


@pytest.mark.gate
def test_where_nothing_is_proved_from_below_nothing_is_drawn_of_it(riccatis):
    nothing = dataclasses.replace(riccatis.below.claim, level=-math.inf)
    below = LowerBoundCertificate(riccatis.controller, nothing, riccatis.options)
    certificate = TwoSidedCertificate(riccatis.above, below, riccatis.options)
    figure = certificate.figure()
    assert not any("costs at least" in text.get_text() and "any" in text.get_text()
                   for legend in figure.legends for text in legend.get_texts())  # fmt: skip
    assert "certified_ratio" not in certificate.result
    assert "every control" not in figure.get_suptitle()


@pytest.mark.parametrize(
    ("states", "words"),
    [
        ([[-1, "nonsense"], [1, 2]], "Expected states as"),
        ([[-2], [2]], "Expected a set of 2 states"),
        ([[-0.5, -2], [2, 2]], "a set around X₀"),
    ],
)
def test_a_set_that_does_not_fit_is_refused_before_the_tube(states, words, monkeypatch):
    monkeypatch.setattr("lyapnet.claims.tubes.tube.prove_tube", lambda *_: pytest.fail("too late"))
    with pytest.raises(UsageError, match=words):
        both_sides(states=states)
