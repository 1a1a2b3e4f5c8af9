"""The report of a comparison: statistics by hand, tables that are read back, figures that show what they say."""

import csv
import io
import math
import re
from dataclasses import replace
from statistics import fmean, stdev

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.text import Text
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from lyapnet.base import tables as layout
from lyapnet.base.drawing import GREY
from lyapnet.base.errors import UsageError
from lyapnet.lab.comparison.report import details as detailed
from lyapnet.lab.comparison.report import figures, summary, write_report
from lyapnet.lab.comparison.report.rows import missing
from lyapnet.lab.comparison.report.table1 import table1
from lyapnet.lab.comparison.results import (
    ControlTimes,
    Measurement,
    Result,
    with_cold_compilation,
    with_common_optima,
)
from lyapnet.lab.comparison.statistics import compared, interquartile_mean, spread
from tests.marks import sample
from tests.problems import untrained

INF = math.inf
SMALL = ("horizon.steps=6", "network.hidden=[8, 8]")
OPTIMA = [1.0, 2.0, 3.0, 4.0]  # mean 2.5


def result(method="lyapnet", seed=0, ratio=1.0, curve=((0, 9.0), (100, 1.0)), task="reacher", **changes):
    """Costs are ratio × optimum, a second is ten steps, the validation states' optimum is 2."""
    ours = method == "lyapnet"
    points = [Measurement(s, s / 10, 2 * r, r, 0.1 * r if ours else None) for s, r in curve]
    costs = [ratio * one for one in OPTIMA]
    return replace(
        Result(
            task, method, seed, curve[-1][0], curve[-1][0] / 10, 1.0 if ours else 0.0, costs, [50 * c for c in costs],
            OPTIMA, 0.01 * (seed + 1) if ours else None, None if ours else 0.25, 170, f"{method}/{seed}.ckpt", points,
        ),
        **changes,
    )  # fmt: skip


def everything():
    """Two tasks, ours with three seeds, PPO in both settings and SAC in one with two; SAC diverges on one."""
    ours = ((0, 9.0), (100, 1.5), (200, 1.05), (300, 1.01))
    slow, near = ((0, 20.0), (200, 10.0), (6000, 3.0)), ((0, 20.0), (250, 8.0), (6000, 1.08))
    found = []
    for task in ("reacher", "double_integrator"):
        found += [result(seed=s, ratio=1 + 0.01 * s, curve=ours, task=task) for s in range(3)]
        found += [result("ppo_paper", s, 3.0 + s, slow, task) for s in range(2)]
        found += [result("ppo_tuned", s, 1.08, near, task) for s in range(2)]
        found += [result("sac_paper", s, 30.0, slow, task) for s in range(2)]
    found[-1] = replace(
        found[-1], costs=[30, 60, INF, 120], curve=[replace(p, cost=INF, cost_ratio=INF) for p in found[-1].curve]
    )
    return found


@pytest.fixture(scope="module")
def comparison():
    return compared(everything())


# Statistics


def test_interquartile_mean_and_its_interval_by_hand():
    values = [[0, 2, 3, 4], [5, 6, 7, 100]]
    assert interquartile_mean(values) == (3 + 4 + 5 + 6) / 4
    found = spread(values)
    assert (found.mean, found.std) == (pytest.approx(15.875), pytest.approx(stdev([2.25, 29.5])))
    assert (found.iqm, found.low, found.high) == (4.5, 2.5, 6.5)  # of the same seed twice, a quarter of the draws each
    assert spread(values) == found


def test_states_of_a_seed_stay_together():
    """Seeds that agree leave no doubt, however much their states differ; the twin's states are seeds."""
    states = np.arange(20.0)
    together = spread([states, states, states])
    assert together.low == together.high == together.iqm
    apart = spread(np.repeat(states, 3)[:, None])
    assert apart.iqm == together.iqm
    assert apart.high is not None
    assert apart.low is not None
    assert apart.high - apart.low > 3


def test_one_seed_has_no_spread_and_a_diverged_one_no_mean():
    alone = spread([[1.0, 2.0, 3.0, 4.0]])
    assert (alone.mean, alone.std, alone.low, alone.high) == (2.5, None, None, None)
    for bad in (INF, math.nan):
        diverged = spread([[1.0, 2.0, 3.0, bad], [1.0, 2.0, 3.0, 4.0]])
        assert (diverged.mean, diverged.std, diverged.diverged) == (INF, None, 1)
        assert diverged.iqm == 2.5  # of 2, 2, 3, 3: an eighth of the states does not move it


def test_cost_ratio_is_of_the_states_whose_optimum_is_known():
    odd = result(costs=[2, 100, 6, 8], optima=[1, math.nan, 3, 4])
    group = compared([odd]).groups["reacher", "lyapnet"]
    assert group.cost_ratio == pytest.approx(16 / 8)
    assert group.optimum == pytest.approx(8 / 3)
    assert group.relative_cost is not None
    assert group.relative_cost.iqm == 2


def reaching(*firsts):
    """Ours with a seed for each step of its first validation within 2 %; None: never."""
    curves = [((0, 9.0), *(((first, 1.01),) if first else ()), (1000, 1.5)) for first in firsts]
    return compared([result(seed=seed, curve=curve) for seed, curve in enumerate(curves)])


@pytest.mark.parametrize(
    ("firsts", "reached", "step"),
    [
        ((100, 300, 500), 3, 300),
        ((100, 300, None), 2, 300),
        ((100, None, None), 1, None),
        ((100, 200, None, None), 2, None),
        ((100, 200, 400, None), 3, 300),
        ((None,), 0, None),
    ],
)
def test_convergence_is_the_median_of_all_seeds(firsts, reached, step):
    comparison = reaching(*firsts)
    reach = comparison.groups["reacher", "lyapnet"].within(1.02)
    assert reach is not None
    assert (reach.reached, reach.seeds, reach.steps) == (reached, len(firsts), step)
    assert reach.seconds == (None if step is None else step / 10)
    assert comparison.convergence_step("reacher") == step


def test_the_threshold_itself_is_within():
    assert compared([result(curve=((0, 2.0), (10, 1.02), (20, 1.0)))]).convergence_step("reacher") == 10
    assert compared([result(curve=((0, 2.0), (10, 1.0201), (20, 1.0)))]).convergence_step("reacher") == 20


def at_convergence(*theirs):
    """A baseline against ours, which has 1.5 times the optimum after 100 steps and the optimum after 300."""
    comparison = compared([result(curve=((0, 9.0), (100, 1.5), (300, 1.0), (500, 1.2))), *theirs])
    return comparison.at_convergence("reacher", "ppo_paper"), detailed.details(comparison).cells()[-1]


def test_a_baseline_counts_with_the_best_that_it_had_until_then():
    at, cells = at_convergence(
        result("ppo_paper", 0, curve=((0, 20.0), (200, 5.0), (299, 7.0), (300, 6.0), (301, 3.0))),  # 5 was kept
        result("ppo_paper", 1, curve=((0, 20.0), (300, 4.0))),  # at that step itself
    )
    assert (at.steps, at.ended, at.cost, at.ours) == (300, False, 4.5, 1.0)
    assert at.factor == 4.5
    assert "4.5000" in cells
    at, _ = at_convergence(result("ppo_paper", curve=((0, 20.0), (200, 5.0), (301, 3.0), (302, 2.0))))
    assert at.cost == 3, "between two validations the later one counts as well"
    ours, _ = at_convergence()
    assert ours is None
    own = compared([result(seed=k, curve=((0, 9.0), (90 + k, 1.0), (500, 1.0))) for k in range(3)])
    at = own.at_convergence("reacher", "lyapnet")
    assert at.ours == at.cost == fmean([1.0, 1.0, 9.0]), "ours has no such favour"
    unknown = result("ppo_paper")
    unknown = replace(unknown, curve=[*unknown.curve, replace(unknown.curve[-1], cost_ratio=None)])
    assert at_convergence(unknown)[0] is None, "costs are not compared with ratios"


def test_a_baseline_that_ended_before_is_compared_where_it_ended():
    at, cells = at_convergence(
        result("ppo_paper", 0, curve=((0, 20.0), (299, 3.0), (400, 1.0))),
        result("ppo_paper", 1, curve=((0, 20.0), (299, 6.0))),
    )
    assert (at.steps, at.ended, at.cost, at.ours) == (299, True, 4.5, 1.5), "nothing is extrapolated, ours neither"
    assert at.factor == 3
    assert "4.5000 (ended at 299)" in cells


def test_costs_there_are_relative_to_each_seeds_own_states():
    harder = [replace(p, cost=10 * p.cost) for p in result("ppo_paper", curve=((0, 9.0), (300, 1.0))).curve]
    at, _ = at_convergence(result("ppo_paper", curve=((0, 9.0), (300, 1.0))), result("ppo_paper", 1, curve=((0, 9.0),)))
    same, _ = at_convergence(replace(result("ppo_paper"), curve=harder, environment_steps=300))
    assert same.factor == 1, "as good, from states that cost ten times as much"
    assert at.ended


def test_every_seed_is_charged_with_the_compilation_that_one_took():
    first = result(seed=0, compilation_seconds=40.0, seconds=90.0)
    second = result(seed=1, compilation_seconds=2.0, seconds=52.0)
    theirs = result("ppo_paper", curve=((0, 9.0), (1000, 1.0)))
    charged = with_cold_compilation([first, second, theirs])
    assert [one.compilation_seconds for one in charged] == [40, 40, 0]
    assert [one.seconds for one in charged] == [90, 90, 100]
    assert [p.seconds for p in charged[1].curve] == [0, 10 + 38]
    assert charged[0].curve == first.curve
    comparison = compared(charged)
    assert comparison.speedup("reacher", "ppo_paper") == (100 / 29, False)
    later = replace(first, curve=[replace(p, seconds=p.seconds + 40) for p in first.curve])
    assert compared([later, theirs]).speedup("reacher", "ppo_paper") == (100 / 50, False)
    assert compared([later, theirs]).speedup("reacher", "ppo_paper", compiled=True) == (100 / 10, False)
    assert compared([first, theirs]).speedup("reacher", "ppo_paper") == (10, False)


def test_budgets_are_told_in_multiples_of_ours():
    ours, theirs = result(curve=((0, 9.0), (100, 1.0), (400, 1.0))), result("ppo_paper", curve=((0, 9.0), (1000, 5.0)))
    row = detailed.details(compared([ours, theirs])).rows[1]
    assert (row["budget_of_all"], row["budget_of_convergence"], row["budget_of_seconds"]) == (2.5, 10, 2.5)


def test_improvement_and_speedup_by_hand(comparison):
    ours = fmean([1.0, 1.01, 1.02])
    assert comparison.improvement("reacher", "ppo_paper") == pytest.approx(3.5 / ours)
    assert comparison.improvement("reacher", "ppo_paper", "sum") == pytest.approx(3.5 / ours)
    assert comparison.at_convergence("reacher", "ppo_paper").factor == pytest.approx(3 / 1.01)
    assert comparison.speedup("reacher", "ppo_tuned") == (600 / 20, False)
    assert comparison.speedup("reacher", "ppo_paper") == (600 / 20, True)
    assert comparison.improvement("double_integrator", "sac_paper") == INF
    assert comparison.improvement("reacher", "sac_tuned") is None


def test_the_lower_bound_of_a_speedup_counts_whole_trainings():
    near, far = ((0, 9.0), (500, 1.0), (9000, 1.0)), ((0, 9.0), (2000, 2.0))
    for curves, expected in (((near, far, far), (200, True)), ((near, near, far), (50, False))):
        theirs = [result("ppo_tuned", seed, curve=curve) for seed, curve in enumerate(curves)]
        comparison = compared([result(curve=((0, 9.0), (10, 1.0))), *theirs])
        assert comparison.speedup("reacher", "ppo_tuned") == expected
    short = [result("ppo_tuned", curve=((0, 9.0), (5, 2.0)))]
    assert compared([result(curve=((0, 9.0), (10, 1.0))), *short]).speedup("reacher", "ppo_tuned") is None


def test_the_best_and_the_last_validation_by_hand():
    curves = ((0, 9.0), (100, 2.0), (200, 2.0), (300, 5.0)), ((0, 3.0), (100, 8.0), (200, 7.0))
    group = compared([result("ppo_tuned", k, curve=c) for k, c in enumerate(curves)]).groups["reacher", "ppo_tuned"]
    assert group.best_steps == (200 + 0) / 2, "of two the later; a training that never learned has its first"
    assert group.last_cost == (5 + 7) / 2


def test_what_does_not_compare_is_refused():
    with pytest.raises(UsageError, match="one result a seed"):
        compared([result(), result()])
    with pytest.raises(UsageError, match="equal evaluation states"):
        compared([result(), result("ppo_paper", optima=[1.0, 2.0, 3.0, 4.1])])
    with pytest.raises(UsageError, match="equal evaluation states"):
        compared([result(), result("ppo_paper", costs=[1.0], sums=[1.0], optima=None)])
    assert compared([result(), result("ppo_paper", optima=[1.0, 2.0, math.nan, 4.0])]).methods == [
        "lyapnet",
        "ppo_paper",
    ]


# Tables


def test_table1_in_every_setting_and_form(comparison):
    several = table1(comparison)
    assert [table.title.rpartition(": ")[2] for table in several] == ["paper", "tuned", "paper", "tuned"]
    assert several[0].cells()[1] == [
        "reacher", "0.020 ± 0.010", "2.525 ± 0.025", "8.8 ± 1.8", "75.00 ± 0", "3.47", "29.7", "170",
    ]  # fmt: skip
    assert several[0].cells()[0][4] == "diverged (1 of 2)"
    assert several[1].cells()[1][4] == layout.NOTHING  # SAC is not there in this setting


def test_the_papers_rows_are_as_printed(comparison):
    rows = {tuple(cells[:2]): cells for cells in table1(comparison)[2].cells()}
    assert rows["reacher", "paper"][2:] == [
        "33.61 ± 20.25", "2,086.24 ± 419.84", "15,514.49 ± 4,465.52", "3,831,267.56 ± 471,973.23", "7.44", "1,836",
        "170",
    ]  # fmt: skip
    assert rows["reacher", "measured"][4] == "438 ± 88"  # fifty times J_N


def test_the_papers_rows_stand_beside_its_own_horizon():
    assert [row["source"] for row in table1(compared([result()]))[-1].rows] == ["measured", "paper"]
    assert [row["source"] for row in table1(compared([result(horizon_steps=12)]))[-1].rows] == ["measured"]


def test_a_cost_stands_alone_where_its_optimum_is_not_known():
    alone = compared([result(optima=None, curve=((0, 9.0), (9, 1.0))), result("ppo_paper", optima=None)])
    assert {cells[2] for cells in summary(alone).cells()} == {"J_N 2.500"}
    assert missing(alone) == ["reacher: J*, which no job knew; new ones find it with lyapnet[oracle]"]


def test_details_say_what_was_reached(comparison):
    table = detailed.details(comparison)
    headings = [column.heading for column in table.columns]
    rows = {(c[0], c[1]): dict(zip(headings, c, strict=True)) for c in table.cells()}
    tuned, plain = rows["reacher", "PPO (tuned)"], rows["reacher", "PPO (paper)"]
    assert (tuned["steps to 10 %"], tuned["seconds to 10 %"], tuned["seconds / ours"]) == ("6,000", "600.0", "30")
    assert plain["steps to 10 %"] == "not reached (0 of 2)"
    assert plain["seconds / ours"] == "> 30"
    assert (plain["seeds"], plain["trained for"], plain["clipped"]) == ("0 1", "6,000", "25.0%")
    assert rows["double integrator", "SAC (paper)"]["cost / J*"] == "diverged"
    assert rows["reacher", "lyapnet"]["seconds / ours"] == layout.NOTHING


def test_the_overview_is_of_the_details(comparison):
    full, chosen = detailed.details(comparison), detailed.overview(comparison)
    assert len(chosen.columns) == len(detailed.OVERVIEW) < len(full.columns)
    assert all(set(few) <= set(many) for few, many in zip(chosen.cells(), full.cells(), strict=True))


def test_a_bound_is_marked_where_compilation_takes_longer_than_the_baseline():
    ours = result(curve=((0, 9.0), (100, 1.0)), compilation_seconds=8.0)
    table = detailed.details(compared([ours, result("ppo_paper", curve=((0, 9.0), (60, 2.0)))]))
    row = dict(zip([column.heading for column in table.columns], table.cells()[-1], strict=True))
    assert row["seconds / ours"] == layout.NOTHING
    assert row["/ ours without compilation"] == "> 3"


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("figure3", "optimality gap of ours"),
        ("final", "interquartile mean"),
        ("certified_region_double_integrator", "Double integrator, ours"),
        ("trajectories_reacher", "Reacher, ours"),
    ],
)
def test_captions_say_what_is_drawn(name, words, comparison):
    assert words in figures.caption(name, comparison)
    alone = compared([result(curve=((0, 9.0), (9, 1.0)))])
    unknown = replace(alone.groups["reacher", "lyapnet"].results[0])
    unknown = replace(unknown, curve=[replace(point, cost_ratio=None) for point in unknown.curve])
    assert "J_N of ours" in figures.caption("figure3", compared([unknown]))


@pytest.mark.parametrize(
    ("limits", "labels"),
    [
        ((2e-4, 30.0), ["0.001", "0.01", "0.1", "1", "10"]),
        ((0.02, 0.4), ["0.02", "0.05", "0.1", "0.2"]),
        ((1e3, 3e7), ["1000", "$10^{4}$", "$10^{5}$", "$10^{6}$", "$10^{7}$"]),
    ],
)
def test_axes_name_powers_of_ten_or_what_is_between_them(limits, labels):
    figure = Figure()
    axes = figure.subplots()
    axes.set(yscale="log", ylim=limits)
    figures.name_decades(axes.yaxis)
    FigureCanvasAgg(figure).draw()
    low, high = limits
    ticks = [(at, text.get_text()) for at, text in zip(axes.get_yticks(), axes.get_yticklabels(), strict=True)]
    assert [text for at, text in ticks if low <= at <= high] == labels


def test_what_is_missing_is_named(comparison):
    assert missing(comparison) == []
    fewer = compared([one for one in everything() if (one.task, one.method, one.seed) != ("reacher", "lyapnet", 1)])
    assert missing(fewer) == ["reacher, lyapnet: 2 of 3 seeds; missing: 1"]
    planned = [("reacher", "sac_tuned", seed) for seed in range(5)]
    assert missing(comparison, planned) == ["reacher, SAC (tuned): 0 of 5 seeds; missing: 0, 1, 2, 3, 4"]


@pytest.mark.parametrize(
    ("mean", "std", "text"),
    [(3.0671, 0.00421, "3.0671 ± 0.0042"), (2086.24, 419.84, "2,086 ± 420"), (2e-5, 1e-5, "2e-05 ± 1e-05"),
     (5.0, None, "5.000"), (16.1, 1e-9, "16.100 ± 1e-09"), (0.0, 0.0, "0 ± 0"), (3.8e8, 4e7, "3.8e+08 ± 4e+07")],
)  # fmt: skip
def test_means_have_the_decimals_that_their_spread_leaves(mean, std, text):
    assert layout.mean_and_std(mean, std) == text


def test_latex_has_a_cell_for_each_column(comparison):
    for table in (*table1(comparison), detailed.tasks_table(comparison), detailed.details(comparison)):
        text = layout.latex(table)
        assert text.isascii()
        columns = len(re.search(r"\\begin\{tabular\}\{(\w+)\}", text)[1])
        rows = [line for line in text.splitlines() if line.endswith(r"\\")]
        assert len(rows) == 1 + len(table.rows)
        assert {len(re.findall(r"(?<!\\)&", row)) for row in rows} == {columns - 1}
        assert [text.count(rule) for rule in (r"\toprule", r"\bottomrule")] == [1, 1]
        plain = re.sub(r"\\[{}]", "", text)
        assert plain.count("{") == plain.count("}")
        assert re.findall(r"\\begin\{(.+?)\}", text) == re.findall(r"\\end\{(.+?)\}", text)[::-1]
        assert len(re.findall(r"(?<!\\)\$", text)) % 2 == 0
    assert layout.escaped("a_b & 5 % ± ∞") == r"a\_b \& 5 \% $\pm$ $\infty$"


# Figures


def drawn(figure):
    FigureCanvasAgg(figure).draw()
    return figure


def lines(axes, color=None):
    return [line for line in axes.get_lines() if color is None or to_hex(line.get_color()) == to_hex(color)]


def test_figure3_shows_means_optimum_and_convergence(comparison):
    figure = drawn(figures.figure3(comparison))
    assert len(figure.axes) == 6
    loss, ours, theirs = figure.axes[1], figure.axes[3], figure.axes[5]  # of the reacher
    assert loss.get_lines()[0].get_xydata() == pytest.approx(np.array([(100, 0.15), (200, 0.105), (300, 0.101)]))
    mean = np.array([(100, 3.0), (200, 2.1), (300, 2.02)])  # of costs whose optimum is 2
    mean[:, 1] = mean[:, 1] / 2 - 1
    assert ours.get_lines()[0].get_xydata() == pytest.approx(mean)
    assert any(line.get_xydata() == pytest.approx(mean) for line in lines(theirs, GREY) if len(line.get_xdata()) == 3)
    assert lines(theirs, figures.LOOKS["ppo_paper"].color)[0].get_xydata() == pytest.approx(
        np.array([(200, 9), (6000, 2)])
    )
    for axes in (ours, theirs):
        assert any(list(line.get_ydata()) == pytest.approx([0.1, 0.1]) for line in lines(axes, "black"))
        assert any(list(line.get_xdata()) == [300, 300] for line in lines(axes, GREY))
        assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
    assert theirs.get_xlabel() == "environment steps"
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert {"ours", "PPO (paper)", "PPO (tuned)", "SAC (paper)", "10 % above the optimum", "a seed diverges"} <= set(
        names
    )
    assert "SAC (tuned)" not in names
    crosses = [line for line in figure.axes[4].get_lines() if line.get_marker() == "x"]
    assert any(len(line.get_xdata()) for line in crosses)
    assert not any(len(line.get_xdata()) for line in theirs.get_lines() if line.get_marker() == "x")


def test_a_band_stays_where_all_seeds_are():
    early, late = result(curve=((0, 9.0), (100, 5.0), (400, 1.0))), result(seed=1, curve=((50, 7.0), (300, 3.0)))
    band = figures.band([early, late], lambda point: point.cost)
    assert band is not None
    assert band.steps.tolist() == [50, 100, 300]
    assert band.mean.tolist() == [(18 + 14) / 2, (10 + 14) / 2, (10 + 6) / 2]  # a seed keeps its last validation
    assert (band.low.tolist(), band.high.tolist()) == ([14, 10, 6], [18, 14, 10])
    assert figures.band([early, result(seed=1, curve=((500, 7.0),))], lambda point: point.cost) is None
    assert figures.band([early, result("ppo_paper")], lambda point: point.constraint_loss) is None


def test_final_figure_has_a_dot_for_each_seed(comparison):
    figure = drawn(figures.final(comparison))
    axes = figure.axes[1]
    row = comparison.methods.index("ppo_paper")
    dots = [line for line in lines(axes, figures.LOOKS["ppo_paper"].color) if line.get_marker() == "o"]
    assert [line.get_xdata()[0] for line in dots] == [2, 3]  # of J/J* − 1
    assert all(row < line.get_ydata()[0] < row + 0.5 for line in dots)
    (interval,) = [line for line in lines(axes, figures.LOOKS["ppo_paper"].color) if len(line.get_xdata()) == 2]
    assert list(interval.get_xdata()) == [2, 3]
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()][row] == "PPO (paper)"


def test_letters_stay_readable_in_print_and_methods_in_grey(comparison):
    controllers = {name: untrained(name, *SMALL) for name in ("double_integrator", "cartpole_balancing")}
    several = {
        "figure3": figures.figure3(comparison),
        "final": figures.final(comparison),
        **figures.pictures(controllers),
    }
    for figure in several.values():
        width = figure.get_size_inches()[0]
        sizes = [text.get_fontsize() for text in drawn(figure).findobj(Text) if text.get_text().strip()]
        assert width <= figures.WIDTH
        assert min(sizes) >= 7
    looks = [figures.look_of(method) for method in ("lyapnet", "ppo_paper", "ppo_tuned", "sac_paper", "sac_tuned")]
    for index in range(3):
        assert len({look[index] for look in looks}) == len(looks)


def test_a_legend_stays_within_its_figure_and_names_what_is_drawn(comparison):
    alone = compared([one for one in everything() if one.task == "reacher"])
    unknown = [
        replace(one, optima=None, curve=[replace(p, cost_ratio=None) for p in one.curve]) for one in everything()
    ]
    for several in (comparison, alone, compared(unknown)):
        for figure in map(drawn, (figures.figure3(several), figures.final(several))):
            box, width = figure.legends[0].get_window_extent(), figure.bbox.width
            assert 0 <= box.x0 < box.x1 <= width
    names = {text.get_text() for text in figures.figure3(compared(unknown)).legends[0].get_texts()}
    assert {"ours", "a seed diverges"} <= names
    assert not {"10 % above the optimum", "ours first within 2 %"} & names


def test_regions_are_drawn_of_lyapunov_programs_alone():
    controllers = {
        "one": untrained("double_integrator", *SMALL),
        "other": untrained("double_integrator_value", *SMALL),
    }
    assert list(figures.pictures(controllers)) == ["certified_region_one", "trajectories_one", "trajectories_other"]


# The report


def rows_of(path):
    return list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8"))))


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    planned = [(one.task, one.method, one.seed) for one in everything()] + [("reacher", "sac_tuned", 0)]
    first = write_report(everything()[:4], folder)
    return folder, first, write_report(everything(), folder, command="lyapnet compare --seeds 3", planned=planned)


@pytest.mark.gate
def test_a_report_replaces_the_earlier_one(written):
    folder, first, second = written
    assert all(path.is_file() for path in second)
    assert sorted(second) == sorted(path for path in folder.rglob("*") if path.is_file())
    assert [path.name for path in first[:-1]] == [path.name for path in second[:-1]]
    events = EventAccumulator(str(folder / "tensorboard"))
    events.Reload()
    assert set(events.Tags()["images"]) == {"comparison/figure3", "comparison/final"}
    (text,) = events.Tensors("comparison/report/text_summary")
    assert text.tensor_proto.string_val[0].decode() == (folder / "report.md").read_text(encoding="utf-8")


@pytest.mark.gate
def test_report_names_its_command_and_what_is_missing(written):
    folder, *_ = written
    text = (folder / "report.md").read_text(encoding="utf-8")
    assert "lyapnet compare --seeds 3" in text
    assert "reacher, SAC (tuned): 0 of 1 seeds; missing: 0" in text
    assert "Euler steps of single trajectories" in text
    for link in re.findall(r"\]\(([^)]+)\)", text):
        assert (folder / link).is_file()
    for table in re.findall(r"(?:^\|.*\n)+", text, flags=re.MULTILINE):
        assert len({len(re.findall(r"(?<!\\)\|", row)) for row in table.splitlines()}) == 1


@pytest.mark.gate
def test_the_csv_files_hold_what_the_tables_say(written):
    folder, *_ = written
    results, (row, *_) = rows_of(folder / "results.csv"), rows_of(folder / "table1.csv")[1:]
    assert (row["form"], row["setting"], row["task"]) == ("cost", "paper", "reacher")
    means = {}
    for name, method in (("lyapnet", "lyapnet"), ("ppo", "ppo_paper")):
        costs = [float(r["cost_mean"]) for r in results if (r["task"], r["method"]) == ("reacher", method)]
        means[name] = fmean(costs)
        assert float(row[f"{name}_mean"]) == pytest.approx(fmean(costs))
        assert float(row[f"{name}_std"]) == pytest.approx(stdev(costs))
    assert float(row["ppo_factor"]) == pytest.approx(means["ppo"] / means["lyapnet"])
    assert len(results) == len(everything())
    assert [float(r["cost_mean"]) for r in results if r["task"] == "double_integrator"][-1] == INF
    assert len(rows_of(folder / "curves.csv")) == sum(len(one.curve) for one in everything())


@pytest.mark.parametrize(
    "chosen",
    sample(
        [
            [result("ppo_tuned")],  # nothing of ours
            [
                result("mine", task="my_task", optima=None, curve=((0, 9.0), (10, 1.0)))
            ],  # names and tasks of a user's own
            [result(curve=((0, 1.0),))],  # one validation, before the first step
            [result(costs=[INF] * 4, sums=[INF] * 4)],
            [replace(one, optima=None, curve=[replace(p, cost_ratio=None) for p in one.curve]) for one in everything()],
        ],
        5,
    ),
    ids=["no ours", "own names", "one validation", "all diverged", "no oracle"],
)
def test_whatever_there_is_is_reported(chosen, tmp_path):
    assert all(path.is_file() for path in write_report(chosen, tmp_path))
    text = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert "nan" not in text
    assert f"{len(chosen)} results" in text


def test_what_else_one_could_take(tmp_path):
    """A state that a planner reaches at less than its optimum had a worse local minimum; what diverges has failed."""
    lqr = replace(
        result("lqr", curve=((0, 1.0),)), curve=[], costs=[1.5, 2.5, 3.0, INF], times=ControlTimes(0.25, 3.0, 1.0)
    )
    ours = result(ratio=1.01)
    mpc = replace(result("mpc_25", curve=((0, 1.0),)), curve=[], costs=[0.5, 2.0, 3.0, 4.0], unsolved_fraction=0.125)
    unknown = [replace(one, optima=[*one.optima[:1], math.nan, *one.optima[2:]]) for one in (lqr, ours, mpc)]
    found = with_common_optima(unknown)
    assert found[0].optima == pytest.approx([0.5, math.nan, 3.0, 4.0], nan_ok=True)
    write_report(found, tmp_path)
    rows = {row["method"]: row for row in rows_of(tmp_path / "alternatives.csv")}
    assert float(rows["lqr"]["failed"]) == pytest.approx(2 / 3), "3 times the optimum, and diverged"
    assert float(rows["lqr"]["worst"]) == INF
    assert float(rows["mpc_25"]["cost_ratio"]) == pytest.approx(1.0)
    assert (rows["lqr"]["median"], rows["lqr"]["first"], rows["lyapnet"]["median"]) == ("0.25", "1.0", "")
    text = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert "MPC (25 % of T)" in text
    assert "| 12.5% |" in text
    alone = tmp_path / "alone"
    assert all(path.is_file() for path in write_report([found[0], found[2]], alone)), "without any learner"
    assert "## Costs" not in (alone / "report.md").read_text(encoding="utf-8")


def test_nothing_is_refused(tmp_path):
    with pytest.raises(UsageError, match="at least one finished job"):
        write_report([], tmp_path)
    assert not list(tmp_path.iterdir())
