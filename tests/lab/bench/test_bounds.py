"""lyapnet bench certify: its enclosures are sound and of their orders, its truths are true, its command runs."""

import functools
import json
import math

import pytest
import torch

from lyapnet import cli
from lyapnet.base.errors import UsageError
from lyapnet.graphs.compilation import has_compiler
from lyapnet.lab.bench import enclosures
from lyapnet.lab.bench import tightness as tightness_of
from lyapnet.lab.bench.conditions import condition_of_chain, condition_of_network
from lyapnet.lab.bench.enclosures import COMPILED, ENCLOSURES, MEAN_VALUE, enclosure, enclosures_of
from lyapnet.lab.bench.proofs import METHODS, attempt, growth
from lyapnet.lab.bench.tightness import order, random_boxes, range_widths, tightness
from lyapnet.prover import elementary_functions, taylor
from lyapnet.prover.bounds import RULES, BoundedFunction
from tests.functions import FUNCTIONS, SMOOTH, box, points_in, without_remainder


def sample():
    """A box of (t, x) in which functions are traced."""
    return torch.tensor([0.0, -1.0, -1.0]), torch.tensor([1.0, 1.0, 1.0])


def interval_violations(function, lower, upper):
    """How many values at points of the boxes lie outside their intervals."""
    bounded = BoundedFunction(lambda t, x: (function(t, x),), sample())
    (image,) = bounded.image(taylor.interval_form(lower, upper))
    low, high = image.interval()
    values = torch.func.vmap(torch.func.vmap(lambda p: function(p[0], p[1:])))(points_in(lower, upper))
    return int(((values < low[:, None]) | (values > high[:, None]) | low[:, None].isnan()).sum())


@pytest.mark.parametrize("name", FUNCTIONS)
def test_values_lie_within_intervals(name):
    for width in (2.0, 0.5, 1e-2, 1e-5, 0.0):
        assert interval_violations(FUNCTIONS[name], *box(width)) == 0


@pytest.mark.parametrize("name", [*SMOOTH, "product"])
def test_intervals_without_their_remainder_are_caught(name, monkeypatch):
    for module, rule in ((elementary_functions, "linearised"), (taylor, "interval_product")):
        monkeypatch.setattr(module, rule, without_remainder(getattr(module, rule)))
    assert interval_violations(FUNCTIONS[name], *box(0.5)) > 0


@pytest.mark.parametrize("name", ["exp", "sigmoid", "sin", "cos", "sqrt", "log1p", "reciprocal", "square", "softplus"])
def test_the_interval_of_a_function_is_its_image(name):
    lower = torch.linspace(0.3, 4, 50)[:, None]
    if name not in ("sqrt", "log1p", "reciprocal"):
        lower = lower - 3
    low, high = getattr(elementary_functions, name)(taylor.interval_form(lower, lower + 2.5)).interval()
    x = lower + 2.5 * torch.linspace(0, 1, 20_001)
    value = (torch.nn.functional.softplus if name == "softplus" else getattr(torch, name))(x)
    torch.testing.assert_close(high[:, 0], value.amax(1), rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(low[:, 0], value.amin(1), rtol=1e-6, atol=1e-6)


def test_the_interval_of_a_product_lies_between_products_of_ends():
    x, y = (
        taylor.interval_form(*torch.tensor([[[1.0]], [[2.0]]])),
        taylor.interval_form(*torch.tensor([[[-1.0]], [[3.0]]])),
    )
    low, high = taylor.multiply(x, y).interval()
    assert (float(low), float(high)) == (pytest.approx(-2), pytest.approx(6))
    unknown = taylor.multiply(x, elementary_functions.reciprocal(y)).interval()  # 1/y has a pole
    assert [float(side) for side in unknown] == [-math.inf, math.inf]


needs_compiler = pytest.mark.skipif(not has_compiler(), reason="needs a C++ compiler")


@pytest.fixture(scope="module")
def case():
    return condition_of_network()


@pytest.fixture(scope="module")
def enclosed(case):
    return enclosures_of(case.condition, (case.lower, case.upper), pytest.fail)


def outside(case, enclose, lower, upper):
    """How many values of c at points of the boxes lie outside their bounds."""
    points = points_in(lower, upper)
    low, high = enclose(lower, upper)
    with torch.no_grad():
        value = case.condition(points[..., 0], points[..., 1:])
    return int(((value < low[:, None]) | (value > high[:, None]) | low[:, None].isnan()).sum())


@pytest.mark.parametrize("name", [*ENCLOSURES, pytest.param(COMPILED, marks=needs_compiler)])
def test_conditions_lie_within_every_enclosure(case, enclosed, name):
    for side in (1.0, 0.3, 0.05, 1e-3, 1e-6, 0.0):
        assert outside(case, enclosed[name], *random_boxes(case, side, 50)) == 0


@pytest.mark.gate
def test_a_mean_value_form_with_the_gradient_of_the_middle_alone_is_caught(case, monkeypatch):
    """The twin: sound only because the gradient is bounded on the whole box."""

    def at_middle(lower, upper):
        return taylor.interval_form((lower + upper) / 2, (lower + upper) / 2)

    monkeypatch.setattr(enclosures, "interval_form", at_middle)
    wrong = enclosure(MEAN_VALUE, case.condition, (case.lower, case.upper))
    assert outside(case, wrong, *random_boxes(case, 0.3, 50)) > 0


@pytest.mark.gate
def test_orders_of_the_excess(case, enclosed):
    """Affine and mean-value forms gain two digits where intervals gain one; forms of second degree begin ahead."""
    rows = {row.enclosure: row for row in tightness(case, enclosed, 30, 1, sides=(0.1, 2e-3, 1e-3, 5e-4))}
    assert rows["affine"].order == pytest.approx(2, abs=0.1)
    assert rows[MEAN_VALUE].order == pytest.approx(2, abs=0.15)
    assert rows["interval"].order == pytest.approx(1, abs=0.1)
    for row in rows.values():
        assert min(row.factors) >= 1
        assert row.boxes_per_second > 0
        assert rows["quadratic"].factors[0] <= row.factors[0] * (1 + 1e-9)
    assert rows["quadratic"].factors[-1] < rows["affine"].factors[-1]
    assert rows["quadratic"].order > 1.9


def test_order_of_a_power():
    sides = (0.4, 0.2, 0.1, 0.05)
    assert order(sides, [100.0, *(3 * side**1.5 for side in sides[1:])]) == pytest.approx(1.5)
    assert math.isnan(order(sides, [1.0, 1.0, math.inf, 1.0]))


def test_widths_of_known_ranges():
    """A linear function has its range between corners, a wave in the middle."""
    lower, upper = torch.tensor([[0.0, -1.0]]), torch.tensor([[1.0, 1.0]])
    assert float(range_widths(lambda t, x: t - 3 * x[..., 0], lower, upper)) == pytest.approx(7)
    wave = range_widths(lambda t, x: torch.cos(2 * (x[..., 0] - 0.4)) + 0 * t, lower, upper)
    assert float(wave) == pytest.approx(1 - math.cos(2.8), rel=1e-6)


@pytest.mark.parametrize("n", [1, 2, 3])
def test_the_truth_of_the_chains(n):
    """c ≤ −δ at s = 1, and in the twin the largest c is δ/10, in a corner."""
    unit_box = torch.rand(4000, n) * 2 - 1
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * n).reshape(-1, n)
    true, twin = condition_of_chain(n).condition, condition_of_chain(n, holds=False).condition
    t = torch.zeros(())
    with torch.no_grad():
        assert float(true(t, unit_box).max()) <= -true.delta + 1e-9
        assert float(twin(t, corners).max()) == pytest.approx(twin.delta / 10, rel=1e-6)
        assert float(twin(t, unit_box).max()) <= twin.delta / 10 + 1e-9


@functools.cache
def proof_by(method):
    """Of a condition that holds."""
    return attempt(condition_of_chain(2), method, 100)


@pytest.mark.parametrize("method", METHODS)
def test_every_method_proves_what_is_true_and_refutes_its_twin(method):
    proof = proof_by(method)
    assert proof.verdict == "certified"
    assert proof.boxes >= 1
    assert attempt(condition_of_chain(2, holds=False), method, 100, holds=False).verdict == "falsified"


def test_a_method_that_stays_unknown_goes_no_further():
    rows = list(growth([2, 1], seconds=0))
    assert [(row.states, row.holds) for row in rows if row.method == "certifier"] == [(1, True), (1, False), (2, False)]
    assert {row.verdict for row in rows if row.holds} == {"unknown"}


def test_interval_arithmetic_takes_more_boxes():
    boxes = {method: proof_by(method).boxes for method in ENCLOSURES}
    assert boxes["quadratic"] <= boxes["affine"] < boxes[MEAN_VALUE] < boxes["interval"]


def test_what_does_not_exist_is_refused(case):
    with pytest.raises(UsageError, match="quadratic, affine, interval, mean value, got 'taylor'"):
        enclosure("taylor", case.condition, (case.lower, case.upper))
    with pytest.raises(UsageError, match="n ≥ 1 integrators, got 0"):
        condition_of_chain(0)
    with pytest.raises(UsageError, match="smaller share"):
        condition_of_chain(2, delta=50.0, holds=False)
    with pytest.raises(UsageError, match=r"rule for bounds, got aten\.erf"):
        enclosures_of(lambda t, x: torch.erf(x.sum(-1)) + t, sample(), pytest.fail)


def test_a_gradient_without_rules_leaves_the_mean_value_form_out(monkeypatch):
    """softplus's second derivative, as torch has it, branches."""
    monkeypatch.delitem(RULES, torch.ops.aten.lt.Scalar)
    said = []

    def c(t, x):
        with torch.enable_grad():
            y = x.sum(-1) if x.requires_grad else x.sum(-1).detach().requires_grad_()
            (slope,) = torch.autograd.grad(torch.nn.functional.softplus(y).sum(), y, create_graph=True)
        return slope + t

    assert enclosures_of(c, sample(), said.append).keys() - {COMPILED} == {"quadratic", "affine", "interval"}
    assert "aten.lt" in said[0]


# The command

QUICK = ["--boxes", "3", "--repeats", "1", "--seconds", "100", "--dimensions", "1"]


@pytest.fixture
def run(capsys, monkeypatch):
    """Arguments of a quick comparison ↦ (status, output, errors); ranges and times are rough."""
    monkeypatch.setattr(tightness_of, "STEPS", 2)
    monkeypatch.setattr(tightness_of, "AT_ONCE", 8)

    def call(*arguments):
        capsys.readouterr()
        return (cli.main(["bench", "certify", *QUICK, *arguments]), *capsys.readouterr())

    return call


@pytest.mark.gate
def test_json_and_figure(run, enclosed, monkeypatch, tmp_path):
    monkeypatch.setattr(enclosures, "enclosures_of", lambda *_: enclosed)  # as traced above
    status, out, err = run("--json", "--figures", str(tmp_path / "new"))
    assert status == 0, err
    result = json.loads(out)
    assert [row["enclosure"] for row in result["tightness"]] == list(enclosed)
    assert [row["method"] for row in result["proofs"]] == [*METHODS, "certifier"]
    assert all(len(row["factors"]) == len(row["sides"]) for row in result["tightness"])
    assert [row["verdict"] for row in result["proofs"]] == ["certified"] * len(METHODS) + ["falsified"]
    assert (tmp_path / "new" / "certify_bench.png").stat().st_size > 0


@pytest.mark.gate
def test_a_checkpoint_and_its_tables(run, tmp_path):
    tiny = ["training.iterations=2", "horizon.steps=8", "rollout.gradient=backprop", "loggers=[csv]"]
    tiny += ["evaluation.validation_states=4", "evaluation.test_states=4"]
    config = ["--config", "conf/from_scratch/double_integrator.yaml", "network.hidden=[8]", f"logs={tmp_path}"]
    assert cli.main(["train", *config, *tiny]) == 0
    checkpoint = tmp_path / "double_integrator_from_scratch/version_0/checkpoints/best.ckpt"
    status, out, err = run(str(checkpoint))
    assert status == 0, err
    assert "double_integrator" in out
    for word in ("quadratic", "affine", "mean value", "interval", "order", "certified", "falsified"):
        assert word in out


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (["--dimensions", "2,0"], "Expected --dimensions as numbers ≥ 1, got '0'"),
        (["--dimensions", "many"], "'many'"),
        (["--boxes", "0"], "boxes"),
        (["nowhere.ckpt"], "nowhere.ckpt"),
    ],
)
def test_what_cannot_be_compared_is_refused_in_one_line(run, arguments, what):
    status, out, err = run(*arguments)
    assert (status, out) == (2, "")
    assert what in err
    assert len(err.strip().splitlines()) == 1


def test_help_names_both_and_the_gradient_is_the_default(capsys):
    assert cli.main(["bench", "--help"]) == 0
    both = capsys.readouterr().out
    assert "gradient" in both
    assert "certify" in both
    for name, shown in (("gradient", "--routes"), ("certify", "--dimensions")):
        assert cli.main(["bench", name, "--help"]) == 0
        assert shown in capsys.readouterr().out
    for named in ([], ["gradient"]):
        assert cli.main(["bench", *named, "--batch", "none"]) == 2
        assert "--batch" in capsys.readouterr().err
