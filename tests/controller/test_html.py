"""What a notebook shows for a controller: what it says, that no text of users becomes HTML, and odd controllers."""

import re
import shutil
from html.parser import HTMLParser

import pytest
import torch

import lyapnet
from lyapnet.base.files import write_json
from lyapnet.exchange.importing import controller_of as imported
from lyapnet.experiment.checkpoint import ZOO, zoo_names
from lyapnet.task.constraints import StateLimits
from lyapnet.task.systems import DoubleIntegrator
from lyapnet.value.expansions import riccati
from tests.marks import sample
from tests.problems import OfExpansion, Quadratic, problem_of, untrained

VOID = {"br"}
ELEMENTS = {"table", "tr", "th", "td", "br", "svg", "title", "g", "path", "text", "polyline", "p", "em"}


class Page(HTMLParser):
    """The elements of a page, all closed in order, and its text."""

    def __init__(self, html: str):
        super().__init__()
        self.open, self.found, self.texts = [], [], []
        self.feed(html)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.found.append(tag)
        if tag not in VOID and not self.get_starttag_text().endswith("/>"):
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.found.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)

    @property
    def text(self) -> str:
        return " ".join(self.texts)


@pytest.fixture(autouse=True)
def _any_time(monkeypatch):
    monkeypatch.setattr("lyapnet.controller.html.SECONDS", float("inf"))


def page_of(shown) -> Page:
    return Page(shown._repr_html_())


def drawn(page: Page) -> int:
    return page.found.count("polyline")


@pytest.mark.parametrize("name", sample(zoo_names(), 6))
def test_a_controller_of_the_zoo_shows_what_it_is(name):
    page = page_of(lyapnet.load(f"zoo:{name}"))
    for text in ("X₀", "controls", "horizon", f"zoo:{name}", "cost / optimum 1.0", "lyapnet view", "V (cost)"):
        assert text in page.text
    assert drawn(page)
    assert not {"script", "img", "link", "iframe"} & {*page.found}


@pytest.mark.gate
def test_the_table_has_names_units_limits_and_the_record():
    controller = lyapnet.load("zoo:pendulum_limited")
    text = page_of(controller).text
    for label, low in zip(controller.system.state_labels, controller.initial_states.lower, strict=True):
        assert label in text
        assert f"from {float(low):.3g}".replace("-", "−") in text
    assert "torque (N·m) from −" in text
    assert f"{controller.origin.steps} steps, ValueProgram, seed 0, lyapnet " in text
    assert "without limits" in page_of(lyapnet.load("zoo:double_integrator")).text


class Hostile(DoubleIntegrator):
    def __init__(self):
        super().__init__()
        self.state_names = ("<script>alert(1)</script>", "v & </svg>")
        self.state_units = ('"><img src=x onerror=alert(1)>', "m/s")
        self.control_names = ("<b>u</b>",)


@pytest.mark.gate
def test_text_of_users_is_escaped(tmp_path, monkeypatch):
    limits = StateLimits([0], [2.0], [1.0], [1.0], ["<i>position</i>"])
    problem = problem_of(Hostile())
    problem.constraints = limits
    shown = [page_of(lyapnet.Controller(problem, Quadratic([[1.0, 0.0], [0.0, 1.0]]), policy=lyapnet.HJBPolicy))]
    folder = tmp_path / "<script>" / "checkpoints"
    folder.mkdir(parents=True)
    shutil.copy(ZOO / "double_integrator.ckpt", folder / "best.ckpt")
    write_json(folder.parent / "evaluation.json", {"cost_ratio": "<script>", "samples": 12})
    shown.append(page_of(lyapnet.load(folder / "best.ckpt", system=Hostile())))
    for page in shown:
        assert {*page.found} == ELEMENTS
        assert "<script>alert(1)</script>" in page.text
        assert drawn(page)
    assert "from 12 states" in shown[1].text
    hostile = lyapnet.load(folder / "best.ckpt", system=Hostile())
    assert "<script>" not in hostile._repr_html_()
    monkeypatch.setattr("lyapnet.controller.html.escape", str)
    assert "<script>" in hostile._repr_html_()


@pytest.mark.gate
def test_numbers_are_those_on_record_beside_the_best_checkpoint(tmp_path):
    folder = tmp_path / "checkpoints"
    folder.mkdir()
    for name in ("best.ckpt", "last.ckpt"):
        shutil.copy(ZOO / "double_integrator.ckpt", folder / name)
    assert "measured" not in page_of(lyapnet.load(folder / "best.ckpt")).text
    write_json(tmp_path / "evaluation.json", {"cost_ratio": 1.25, "value_error": None, "samples": 7})
    assert "cost / optimum 1.2500, from 7 states" in page_of(lyapnet.load(folder / "best.ckpt")).text
    assert "measured" not in page_of(lyapnet.load(folder / "last.ckpt")).text
    write_json(tmp_path / "evaluation.json", {"satisfied_fraction": 0.5})
    controller = lyapnet.load(folder / "best.ckpt")
    assert "Lyapunov condition on 50.0%" in page_of(controller).text
    controller.program = lyapnet.ValueProgram()
    assert "Lyapunov condition" not in page_of(controller).text
    (tmp_path / "evaluation.json").write_text("[1, 2")
    assert "measured" not in page_of(lyapnet.load(folder / "best.ckpt")).text


@pytest.mark.gate
def test_the_command_for_a_page_names_own_classes_that_it_can_import(monkeypatch):
    controller = lyapnet.load("zoo:double_integrator")
    for name, there in (("my_module:Cart", True), ("__main__:Cart", False)):
        controller.config.system.name = name
        assert (f"--system {name} --out page.html" in page_of(controller).text) == there
        assert ("lyapnet view" in page_of(controller).text) == there


def controller_of(problem, **options):
    return lyapnet.Controller(problem, OfExpansion(problem, riccati(problem)).to(torch.float64), **options)


def test_controllers_without_a_file():
    page = page_of(controller_of(problem_of(DoubleIntegrator())))
    assert "trained" not in page.text
    assert drawn(page) == 4 * 5  # two states, a control and V, from the centre and four corners


# no end, a reference, weights as parameters, noise, outputs, constraints, many states
ODD = ["regions/double_integrator", "reacher_circle", "pendulum_weights", "pendulum_noise", "cartpole_outputs"]
ODD += ["keep_out", "integrator_chain"]


@pytest.mark.parametrize("name", sample(ODD, 3))
def test_odd_tasks_are_shown(name):
    page = page_of(untrained(name))
    assert "horizon" in page.text
    assert drawn(page) or "There is no drawing of closed loops" in page.text


@pytest.mark.gate
def test_a_member_another_law_after_the_horizon_float32_and_an_estimator_are_shown():
    family = lyapnet.load("zoo:cartpole_family")
    assert drawn(page_of(family.with_(pole_mass=0.9, length=1.1)))
    balancing = lyapnet.load("zoo:cartpole_balancing")
    assert "zoo:cartpole_balancing" in page_of(balancing.continued("hold")).text
    loop = balancing.with_estimator("ukf", measure=["cart position", "pole angle"], noise=[0.01, 0.02])
    text = page_of(loop).text
    assert "pole angle ± 0.02 rad" in text
    assert "t = 0 s" in text
    single = untrained("double_integrator", "training.precision=float32")
    single = lyapnet.Controller(single.problem.to(torch.float32), single.V.to(torch.float32), policy=lyapnet.HJBPolicy)
    assert drawn(page_of(single))


def test_a_law_of_others_is_shown():
    value, law = (
        torch.nn.Sequential(torch.nn.Linear(2, 4), torch.nn.Tanh(), torch.nn.Linear(4, 1)),
        torch.nn.Linear(2, 1),
    )
    page = page_of(imported(problem_of(DoubleIntegrator()), value, law))
    assert "GivenValue, GivenLaw" in page.text
    assert drawn(page)


class Raising(DoubleIntegrator):
    def g(self, x):
        raise ValueError("<g> fails")


class Unlimited(lyapnet.Unbounded):
    @property
    def limits(self):
        raise RuntimeError("no limits\nhere")


def test_a_table_that_fails_is_a_sentence():
    problem = problem_of(DoubleIntegrator())
    controller = controller_of(problem)
    assert "There is no table" not in page_of(controller).text
    problem.controls = Unlimited()
    assert "There is no table: RuntimeError: no limits here" in page_of(controller).text


def test_what_cannot_be_drawn_is_said(monkeypatch):
    broken = lyapnet.Controller(problem_of(Raising()), Quadratic([[1.0, 0.0], [0.0, 1.0]]), policy=lyapnet.HJBPolicy)
    page = page_of(broken)
    assert "There is no drawing of closed loops: ValueError: <g> fails" in page.text
    assert "X₀" in page.text
    monkeypatch.setattr("lyapnet.controller.html.SECONDS", 0.0)
    slow = page_of(controller_of(problem_of(DoubleIntegrator())))
    assert re.search(r"they take about \d+ s", slow.text)
    assert not drawn(slow)
