"""The page of a controller: it says what the controller says, answers a slider and clicks, and refuses clearly."""

import json
import re
import shutil
import subprocess
import sys
from functools import cache
from html.parser import HTMLParser

import pytest
import torch

from lyapnet.base.errors import UsageError
from lyapnet.claims.checking import KeptSide
from lyapnet.cli import main
from lyapnet.controller.controller import Controller
from lyapnet.controller.loading import load
from lyapnet.exchange.view import page, page_of
from lyapnet.task.sets import Box
from tests.problems import Formula, untrained

pytestmark = pytest.mark.gate

pytest.importorskip("plotly")
BROWSER = shutil.which("chromium-headless-shell") or shutil.which("chromium")
FIXTURE = "tests/fixtures/version_0.1/certified/checkpoints/best.ckpt"
ACT = """<script>window.addEventListener("load", async () => {
  const pause = (ms) => new Promise((done) => setTimeout(done, ms)), told = [];
  const tell = () => told.push([chosen.t, chosen.loops.length, element("plane").data[0].z[0][0]].join());
  const slide = async () => {
    element("t").value = 3;
    element("t").dispatchEvent(new Event("input"));
    await pause(300);
  };
  const click = async (a, b) => {
    const drag = document.querySelector("#plane .nsewdrag"), box = drag.getBoundingClientRect();
    const { xaxis, yaxis } = element("plane")._fullLayout;
    const place = { clientX: box.left + xaxis.d2p(a), clientY: box.top + yaxis.d2p(b) };
    const send = (to, kind) => to.dispatchEvent(new MouseEvent(kind, { ...place, bubbles: true, view: window }));
    send(drag, "mousemove"); await pause(300);
    send(drag, "mousedown"); await pause(20);
    send(document.querySelector(".dragcover") || drag, "mouseup"); await pause(500);
  };
  await (async () => { DO })();
  document.title = told.join(" ");
});</script></body>"""
SLIDE_AND_CLICK = "tell(); await slide(); tell(); await click(-0.4, 0.1); tell();"
WARNED = """told.push([!element("outside").hidden, element("plane").data.at(-2).line.dash,
                       element("plane").data.at(-2).name.includes("outside")].join());"""


@pytest.fixture(scope="module", autouse=True)
def _written_once():
    """What a page computes is traced and written once for each controller, as it takes seconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(page, "functions_of", cache(page.functions_of))
        patch.setattr(
            "lyapnet.value.policy.DESCENTS_WITH_CONSTRAINTS", 2
        )  # steps of a law that looks ahead, each of which is in the page
        yield


@cache
def controller_of(name, *overrides):
    return untrained(name, "horizon.steps=6", *overrides)


@cache
def page_for(name, *overrides):
    return page_of(controller_of(name, *overrides), f"controller of {name}")


def shown(page, folder, act=SLIDE_AND_CLICK, width=1300):
    """What a browser makes of a page: the title that ACT leaves, and the line of the check."""
    if BROWSER is None:
        pytest.skip("no chromium-headless-shell or chromium")
    path = folder / "page.html"
    path.write_text(ACT.replace("DO", act).join(page.rsplit("</body>", 1)), encoding="utf-8")
    options = ["--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--virtual-time-budget=10000"]
    command = [BROWSER, *options, f"--window-size={width},900", "--dump-dom", f"file://{path}"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    return re.findall(r"<title>(.*?)</title>", done.stdout)[0], re.findall(r'id="check"[^>]*>(.*?)</p>', done.stdout)[0]


def test_a_slider_and_a_click_change_what_is_drawn(tmp_path):
    page = page_for("double_integrator")
    assert len(page) < 8e6
    title, check = shown(page, tmp_path)
    before, later, clicked = (state.split(",") for state in title.split())
    assert before[0] == "0"
    assert float(later[0]) > 0
    assert before[2] != later[2]
    assert [before[1], later[1], clicked[1]] == ["0", "0", "1"]
    assert float(re.search(r"controller by (\S+) at", check)[1]) < 1e-9


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("cartpole_family", ["network.hidden=[8]"]),  # parameters of the system, which the page asks for
        ("three_link_arm", ["network.hidden=[8]"]),  # a linear system of three equations in f
        ("keep_out", ["network.hidden=[8]"]),  # constraints
        ("integrator_chain", ["system.parameters.length=1", "network.hidden=[8]"]),  # one state, on both axes
    ],
)
def test_a_page_computes_what_the_controller_does(name, overrides, tmp_path):
    _, check = shown(page_for(name, *overrides), tmp_path)
    assert float(re.search(r"controller by (\S+) at", check)[1]) < 1e-9, check


def test_a_page_computes_a_function_that_javascript_lacks(tmp_path):
    problem = controller_of("double_integrator").problem
    page = page_of(Controller(problem, Formula(lambda t, x: (x**2).sum(-1) * (1 + t) + torch.erf(x[..., 0]))), "erf")
    _, check = shown(page, tmp_path)
    assert float(re.search(r"controller by (\S+) at", check)[1]) < 1e-9, check


def test_a_page_that_differs_from_the_controller_says_so(tmp_path):
    page = page_for("double_integrator")
    wrong = page.replace('"V": [', '"V": [9e9, ')
    assert "do not use it" in shown(wrong, tmp_path)[1]


def test_a_start_outside_of_the_initial_states_is_told(tmp_path):
    page = page_for("double_integrator")
    places = ("0.9, -0.6", "1.07, 0.1", "-0.9, 0.6", "0.1, -0.75")  # X₀ is |position| ≤ 1, |velocity| ≤ 0.7
    title, _ = shown(page, tmp_path, " ".join(f"await click({place}); {WARNED}" for place in places))
    inside, outside = "false,solid,false", "true,dash,true"
    assert title.split() == [inside, outside, inside, outside]


def test_the_warning_goes_with_the_closed_loops(tmp_path):
    page = page_for("double_integrator")
    hidden = 'told.push(element("outside").hidden);'
    title, _ = shown(page, tmp_path, f'{hidden} await click(1.07, 0.1); {hidden} element("clear").click(); {hidden}')
    assert title.split() == ["true", "false", "true"]


def test_the_warning_says_where_a_proved_funnel_holds(tmp_path):
    controller = controller_of("double_integrator")
    states = Box(torch.tensor([-2.0, -2.0]), torch.tensor([2.0, 2.0]))
    funnel = KeptSide(0.1, 0.0, states, None, None, steps=False, degree=2, rho=1e9, seconds=1.0)
    page = page_of(controller, "double integrator", funnel)
    says = 'await click(1.5, 0.1); told.push(element("outside").textContent.includes("only the proved funnel"));'
    assert shown(page, tmp_path, says)[0] == "true"
    assert shown(page.replace('"rho": 1000000000.0', '"rho": -1.0'), tmp_path, says)[0] == "false"


def test_a_click_beside_thin_initial_states_starts_in_them(tmp_path):
    page = page_for("cartpole_family", "network.hidden=[8]")
    at_side = f"await click(share * axis(0).high, 3.2); {WARNED}"
    title, _ = shown(page, tmp_path, f"for (const share of [0.03, 0.5]) {{ {at_side} }}")
    assert title.split() == ["false,solid,false", "true,dash,true"]  # the cart's position is 0 in X₀


def test_the_last_closed_loop_follows_the_sliders_of_the_parameters(tmp_path):
    """From the same start, with the cost that the controller has there; a weight is shown as such."""
    controller = controller_of("pendulum_weights", "network.hidden=[8]")
    act = """const tells = () => {
      const { number, cost, x } = chosen.loops.at(-1), weight = element("parameter2").nextElementSibling.textContent;
      const named = element("loops").innerText.includes("Q_angle");
      told.push([chosen.loops.length, number, cost, ...x[0], weight, named].join());
    };
    const { lower } = facts.initialStates, to = lower[2] + 0.1;
    await click(lower[0] + 0.2, lower[1] + 0.2); tells();
    element("parameter2").value = to; tells();
    element("parameter2").dispatchEvent(new Event("input")); await pause(500); tells();
    element("keep").click(); element("parameter2").value = to + 0.2;
    element("parameter2").dispatchEvent(new Event("input")); await pause(500); tells();
    told.push(chosen.loops[0].x[0][2]);"""
    title, check = shown(page_for("pendulum_weights", "network.hidden=[8]"), tmp_path, act)
    *states, kept = title.split()
    before, unheard, after, second = (state.split(",") for state in states)
    assert float(re.search(r"controller by (\S+) at", check)[1]) < 1e-9
    assert before == unheard, "nothing happens before the slider says so"
    assert (before[:2], after[:2], second[:2]) == (["1", "1"], ["1", "1"], ["2", "2"])
    assert before[3:5] == after[3:5] == second[3:5], "the start stays"
    assert float(after[7]) == pytest.approx(10 ** float(after[5]), rel=1e-3)
    assert float(kept) == float(after[5]) == pytest.approx(float(second[5]) - 0.2)
    for state in (before, after, second):
        cost = controller.rollout(torch.tensor([float(each) for each in state[3:7]])).cost
        assert float(state[2]) == pytest.approx(float(cost), rel=1e-6)
    assert {state[8] for state in (before, after, second)} == {"true"}
    assert len({state[2] for state in (before, after, second)}) == 3


def test_sliders_are_for_families(tmp_path):
    act = """const hidden = ["follow", "keep"].map((id) => element(id).hidden);
    told.push([element("parameters").children.length, ...hidden].join());"""
    assert shown(page_for("double_integrator"), tmp_path, act)[0] == "0,true,true"
    assert shown(page_for("cartpole_family", "network.hidden=[8]"), tmp_path, act)[0] == "2,false,false"


@pytest.mark.parametrize(
    ("name", "overrides", "width"),
    [
        ("three_link_arm", ["network.hidden=[8]"], 420),
        ("keep_out", ["network.hidden=[8]"], 420),
        ("double_integrator", [], 800),
    ],
)
def test_a_page_fits_its_window(name, overrides, width, tmp_path):
    page = page_for(name, *overrides)
    act = """await click(0, 0.1); const right = (found) => found.getBoundingClientRect().right;
    told.push([innerWidth, Math.max(...[...document.querySelectorAll("body *")].map(right))].join());"""
    window, right = map(float, shown(page, tmp_path, act, width)[0].split(","))
    assert window == width
    assert right <= width
    wide = page.replace("</style>", "#plane { width: 900px; }</style>")
    assert float(shown(wide, tmp_path, act, width)[0].split(",")[1]) > width


def test_a_page_fits_a_window_that_is_narrowed(tmp_path):
    """In a frame of 1300 px that becomes one of 420 px, after two closed loops: as a page that was opened there."""
    page = page_of(load("zoo:cartpole_limited"), "cart-pole")
    loops = "await click(-0.1, 0.1); await click(0.1, 0.1);"
    measure = """const map = document.querySelector("#plane .nsewdrag").getBoundingClientRect();
    told.push(Math.round(map.width), Math.round(map.height));"""
    act = f"{loops} frameElement.style.width = '420px'; await pause(1000); await click(0, 0.2); {measure}"
    act = ACT.replace("DO", act).replace("document.title =", "parent.document.title =")
    inner = json.dumps(act.join(page.rsplit("</body>", 1))).replace("</", "<\\/").replace("<!--", "<\\!--")
    outer = f"""<!DOCTYPE html><title></title><body><p id="check"></p>
    <iframe id="frame" style="width: 1300px; height: 900px"></iframe>
    <script>document.getElementById("frame").srcdoc = {inner};</script></body>"""
    opened = shown(page, tmp_path, f"{loops} await click(0, 0.2); {measure}", 420)[0]
    narrowed = shown(outer, tmp_path, "", 1400)[0]
    assert [int(size) for size in narrowed.split()] == pytest.approx([int(size) for size in opened.split()], abs=40)


def test_a_missing_plotly_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    with pytest.raises(UsageError, match=r'pip install "lyapnet\[view\]"'):
        page_of(controller_of("double_integrator"), "double integrator")


def test_the_command_refuses_another_ending(tmp_path, capsys, caplog):
    assert main(["view", FIXTURE, "--out", str(tmp_path / "page.png")]) != 0
    assert ".html" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


HOSTILE = ["<!--<script>", "</script><script>alert(1)</script>", "</ScRiPt >", "<![CDATA[", "]]>", "&lt;/script&gt;",
           "a\u2028b\u2029c", "<img src=x onerror=alert(1)>", "\\u003c/script>", "'\"`${1}"]  # fmt: skip


def test_no_title_ends_or_begins_a_script(monkeypatch):
    class Elements(HTMLParser):
        """The scripts of a page as a browser ends them, and every other element of it."""

        def __init__(self):
            super().__init__()
            self.names, self.texts = [], []

        def handle_starttag(self, tag, attrs):
            self.names.append(tag)
            self.texts.append("")

        def handle_data(self, data):
            if self.texts:
                self.texts[-1] += data

    monkeypatch.setattr("plotly.offline.get_plotlyjs", lambda: "")
    controller, names = controller_of("double_integrator"), set()
    for title in ("plain", *HOSTILE):
        page = page_of(controller, title)
        found = Elements()
        found.feed(page)
        facts = next(text for text in found.texts if text.startswith('{"title"'))
        assert json.loads(facts)["title"] == title
        names.add(tuple(found.names))
        assert not set("<>&\u2028\u2029") & set(facts)
    assert len(names) == 1, "all pages have the same elements"
