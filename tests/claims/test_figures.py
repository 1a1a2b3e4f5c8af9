"""Figures of certificates show exactly the claim, for any number of states."""

import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg

from lyapnet.claims.figures import funnel, region, sampled_states
from lyapnet.claims.funnel import ProvedFunnel
from lyapnet.claims.region import ProvedRegion
from lyapnet.claims.sampling_certificates import SampledCertificate, StatisticalCertificate
from lyapnet.claims.statistical import BoundedShare, CountedSuccesses
from lyapnet.controller.controller import Controller
from lyapnet.loop.programs import Tolerances
from lyapnet.prover.counterexamples import Counterexample
from lyapnet.task.sets import Box
from lyapnet.task.systems import Cartpole, DoubleIntegrator
from tests.problems import Formula, problem_of

LABELS = DoubleIntegrator().state_labels


def bowl():
    return Formula(lambda t, x: (x**2).sum(-1) + 0 * t)


def cube(side, dimension):
    return Box(torch.full((dimension,), -side), torch.full((dimension,), side))


def claim(rho, dimension=2, wanted=2.0, found=None):
    share = 0.5 if rho > 0 else 0.0
    undecided = torch.empty(0, 1 + dimension)
    D = cube(2.0, dimension)
    return ProvedFunnel(
        alpha=0.9, delta=0.01, duration=4.0, states=D, rho=rho, wanted=wanted, least=wanted, volume_share=share,
        terminal_excess=0.0, counterexample=found, boxes=10, seconds=1.0, remaining_volume=0.0, undecided=undecided,
        left_out=[],
    )  # fmt: skip


def draw(figure):
    FigureCanvasAgg(figure).draw()
    return figure


def outlines(axes):
    """Squared radii of the lines of level sets."""
    lines = [c for c in axes.collections if not c.get_facecolor().size]
    return [(path.vertices**2).sum(-1) for c in lines for path in c.get_paths() if len(path.vertices)]


def legend(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_the_funnel_of_two_states_is_drawn_with_its_levels():
    figure = draw(funnel(claim(1.0, wanted=1.0), bowl(), cube(1.0, 2), torch.zeros(2), LABELS))
    (axes,) = figure.axes
    levels = [1.0 + 0.01 * t for t in (0, 1, 2, 3, 4)]
    for radii, level in zip(outlines(axes), levels, strict=True):
        assert radii == pytest.approx(level, rel=1e-2)
    assert "certified: 50.000% of X₀" in figure.get_suptitle()


def test_what_is_not_proved_is_not_drawn_as_proved():
    figure = draw(funnel(claim(-float("inf")), bowl(), cube(1.0, 2), torch.zeros(2), LABELS))
    (wanted,) = outlines(figure.axes[0])
    assert wanted == pytest.approx(2.0, rel=1e-2)
    assert "V(0, ·) ≤ ρ for all of X₀, not proved" in legend(figure)
    assert not any("ρ + δt" in name for name in legend(figure))
    assert "no funnel proved" in figure.get_suptitle()
    assert not any(c.get_facecolor().size for c in figure.axes[0].collections)


def test_four_states_have_six_slices_that_say_where_they_lie():
    system, X0 = Cartpole(), Box([-0.6, -0.5, -0.2, -0.1], [0.6, 0.5, 0.2, 0.1])
    figure = draw(funnel(claim(1.0, 4), bowl(), X0, torch.zeros(4), system.state_labels))
    assert len(figure.axes) == 6
    shown = {(axes.get_xlabel(), axes.get_ylabel()) for axes in figure.axes}
    assert len(shown) == 6
    assert figure.axes[0].get_title() == "slice: cart velocity = pole velocity = 0"
    for axes in figure.axes:
        for radii, level in zip(outlines(axes), (1.0, 1.04, 2.0), strict=True):
            assert radii == pytest.approx(level, rel=1e-2)
        names = [system.state_labels.index(label) for label in (axes.get_xlabel(), axes.get_ylabel())]
        (box,) = [patch for patch in axes.patches if patch.get_label() == "X₀"]
        assert [box.get_width(), box.get_height()] == pytest.approx(X0.widths[names].tolist())
        assert axes.get_xlim() == (-2, 2)


def test_initial_states_off_the_slice_are_called_projected():
    figure = draw(
        funnel(claim(1.0, 3), bowl(), Box([-0.5, -0.5, 0.5], [0.5, 0.5, 1.0]), torch.zeros(3), ["a (m)", "b", "c"])
    )
    assert [axes.patches[0].get_label() for axes in figure.axes] == ["X₀, projected", "X₀", "X₀"]
    assert {"X₀", "X₀, projected"} <= set(legend(figure))


def test_a_counterexample_is_marked_where_it_lies_and_where_it_is_projected():
    found = Counterexample(1.0, [0.5, 1.5, 0.01], 0.1, 2.4)
    figure = draw(funnel(claim(1.0, 3, found=found), bowl(), cube(1.0, 3), torch.zeros(3), ["a", "b", "c"]))
    marked = [[line.get_label() for line in axes.lines if "fails" in str(line.get_label())] for axes in figure.axes]
    name = "condition fails, t = 1 s"
    assert marked == [[name], [f"{name} (projected onto the slice)"], [f"{name} (projected onto the slice)"]]
    at = [line.get_xydata().tolist() for line in figure.axes[2].lines if "fails" in str(line.get_label())]
    assert at == [[[1.5, 0.01]]]


def test_many_states_are_drawn_along_the_four_widest_of_the_initial_states():
    X0 = Box(-torch.arange(1.0, 7), torch.arange(1.0, 7))
    figure = funnel(claim(1.0, 6), bowl(), X0, torch.zeros(6), [f"x{i}" for i in range(6)])
    assert {axes.get_xlabel() for axes in figure.axes} | {axes.get_ylabel() for axes in figure.axes} == {
        "x2", "x3", "x4", "x5",
    }  # fmt: skip


def test_one_state_is_drawn_over_time():
    found = Counterexample(1.0, [1.5], 0.1, 2.4)
    (axes,) = draw(funnel(claim(1.0, 1, found=found), bowl(), cube(0.5, 1), torch.zeros(1), ["x"])).axes
    assert axes.get_xlabel() == "time (s)"
    (edge,) = [path.vertices for c in axes.collections if not c.get_facecolor().size for path in c.get_paths()]
    assert edge[:, 1] ** 2 == pytest.approx(1 + 0.01 * edge[:, 0], rel=1e-2)


# Sampled states


def sampled(held, states=None, limits=None):
    held = torch.tensor(held)
    held = torch.cat([held, *([torch.ones_like(held[:, :1])] * (held.shape[1] < 4))], -1)
    held = torch.cat([held, held.all(-1, keepdim=True)], -1)
    states = cube(1.0, 2).sample(len(held), torch.Generator().manual_seed(0)) if states is None else states
    return CountedSuccesses(states, held, limits or Tolerances(0.1, 1e-2, 0.05))


def points(figure):
    """Label in the legend ↦ the states drawn in its colour."""
    (axes,) = figure.axes
    colours = {
        h.get_color(): t.get_text()
        for h, t in zip(figure.legends[0].legend_handles, figure.legends[0].texts, strict=True)
    }
    return {colours[line.get_color()]: torch.tensor(line.get_xydata()) for line in axes.lines}


def test_each_state_is_drawn_once_and_as_what_became_of_it():
    one = sampled([[True, True, True], [True, False, False], [False, True, True], [True, True, False], [True] * 3])
    shown = points(draw(sampled_states(one, cube(1.0, 2), LABELS, "")))
    assert shown.keys() == {"success: 2", "‖x(T)‖ > 0.1: 1", "V does not fall: 1", "J > 1.05 V(0, x₀): 1"}
    for name, rows in (("success: 2", [0, 4]), ("‖x(T)‖ > 0.1: 1", [1]), ("V does not fall: 1", [2])):
        assert torch.equal(shown[name], one.states[rows])


def test_a_violation_is_drawn_as_one():
    one = sampled([[True] * 3 + [False], [False] * 4, [True] * 4])
    shown = points(draw(sampled_states(one, cube(1.0, 2), LABELS, "")))
    assert {name: len(states) for name, states in shown.items()} == {"success: 1": 1, "violates a constraint: 2": 2}


def controller():
    return Controller(problem_of(DoubleIntegrator()), bowl())


def test_the_headline_says_what_is_claimed():
    one = sampled([[True] * 3] * 300)
    figure = SampledCertificate(controller(), one, {}).figure()
    assert figure.axes[0].get_title() == "sampled, unknown: 300 of 300 states succeed"
    bound = BoundedShare(one.states, one.held, one.tolerances, 1 - 1e-6, 0.9)
    title = StatisticalCertificate(controller(), bound, {}).figure().axes[0].get_title()
    assert title == "statistical, certified: at least 95.499% of X₀, confidence 1 − 1e-06\n300 of 300 states succeed"


def test_a_projection_says_so_and_one_free_state_is_binned():
    states = torch.rand(50, 4)
    one = sampled([[True] * 3, [False] * 3] * 25, states)
    figure = draw(sampled_states(one, Box([0.0] * 4, [1.0, 1.0, 0.5, 0.0]), Cartpole().state_labels, ""))
    assert figure.axes[0].get_title().endswith("\nprojected along cart velocity")
    figure = draw(sampled_states(one, Box([0.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]), Cartpole().state_labels, ""))
    (axes,) = figure.axes
    assert axes.get_xlabel() == "pole angle (rad)"
    assert sum(patch.get_height() for patch in axes.patches) == 50


def region_of(rho, wanted):
    proved = 0.25 if rho > 0 else 0.0
    return ProvedRegion(
        decay=0.01, states=cube(2.0, 2), rho=rho, rim=4.0, wanted=wanted, least=wanted, hole=0.1, contraction=None,
        slowest=-1.0, volume_share=proved, region_share=proved, proof=None, seconds=1.0, left_out=[],
    )  # fmt: skip


def test_the_region_is_drawn_with_its_level():
    paths = torch.zeros(3, 5, 2)
    figure = draw(region(region_of(1.0, 1.0), bowl(), cube(0.5, 2), torch.zeros(2), LABELS, paths=paths))
    (edge,) = outlines(figure.axes[0])
    assert edge == pytest.approx(1.0, rel=1e-2)
    assert "certified: 25.000% of D, 25.000% of X₀" in figure.get_suptitle()
    assert "closed loops under u(0, x)" in legend(figure)


def test_a_region_that_is_not_proved_is_not_drawn_as_proved():
    figure = draw(region(region_of(-float("inf"), 2.0), bowl(), cube(0.5, 2), torch.zeros(2), LABELS))
    (wanted,) = outlines(figure.axes[0])
    assert wanted == pytest.approx(2.0, rel=1e-2)
    assert "no region proved" in figure.get_suptitle()
    assert "V(0, x) ≤ ρ for all of X₀, not proved" in legend(figure)
    assert not any(name.startswith("V(0, x) ≤ ρ: ") for name in legend(figure))
