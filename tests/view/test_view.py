"""The page of a controller: it says what the controller says, answers a slider and clicks, and refuses clearly."""

import json
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser

import pytest
import torch

from lyapnet.cli import main
from lyapnet.controller import Controller
from lyapnet.errors import UsageError
from lyapnet.view import page_of
from tests.problems import Formula, untrained

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
  const click = async () => {
    const drag = document.querySelector("#plane .nsewdrag"), box = drag.getBoundingClientRect();
    const place = { clientX: box.left + 0.3 * box.width, clientY: box.top + 0.4 * box.height };
    const send = (to, kind) => to.dispatchEvent(new MouseEvent(kind, { ...place, bubbles: true, view: window }));
    send(drag, "mousemove"); await pause(300);
    send(drag, "mousedown"); await pause(20);
    send(document.querySelector(".dragcover") || drag, "mouseup"); await pause(500);
  };
  tell(); await slide(); tell(); await click(); tell();
  document.title = told.join(" ");
});</script></body>"""


def shown(page, folder):
    """What a browser makes of a page: the title that ACT leaves, and the line of the check."""
    if BROWSER is None:
        pytest.skip("no chromium-headless-shell or chromium")
    path = folder / "page.html"
    path.write_text(ACT.join(page.rsplit("</body>", 1)), encoding="utf-8")
    options = ["--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--virtual-time-budget=10000", "--dump-dom"]
    done = subprocess.run([BROWSER, *options, f"file://{path}"], capture_output=True, text=True, timeout=60, check=True)
    return re.findall(r"<title>(.*?)</title>", done.stdout)[0], re.findall(r'id="check"[^>]*>(.*?)</p>', done.stdout)[0]


def test_a_slider_and_a_click_change_what_is_drawn(tmp_path):
    page = page_of(untrained("double_integrator", "horizon.steps=6"), "double integrator")
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
    page = page_of(untrained(name, "horizon.steps=6", *overrides), name)
    _, check = shown(page, tmp_path)
    assert float(re.search(r"controller by (\S+) at", check)[1]) < 1e-9, check


def test_a_page_computes_a_function_that_javascript_lacks(tmp_path):
    problem = untrained("double_integrator", "horizon.steps=6").problem
    page = page_of(Controller(problem, Formula(lambda t, x: (x**2).sum(-1) * (1 + t) + torch.erf(x[..., 0]))), "erf")
    _, check = shown(page, tmp_path)
    assert float(re.search(r"controller by (\S+) at", check)[1]) < 1e-9, check


def test_a_page_that_differs_from_the_controller_says_so(tmp_path):
    page = page_of(untrained("double_integrator", "horizon.steps=6"), "double integrator")
    wrong = page.replace('"V": [', '"V": [9e9, ')
    assert "do not use it" in shown(wrong, tmp_path)[1]


def test_a_missing_plotly_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    with pytest.raises(UsageError, match=r'pip install "lyapnet\[view\]"'):
        page_of(untrained("pendulum_limited", "horizon.steps=6"), "pendulum")


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
    controller, names = untrained("double_integrator", "horizon.steps=6", "network.hidden=[4]"), set()
    for title in ("plain", *HOSTILE):
        page = page_of(controller, title)
        found = Elements()
        found.feed(page)
        facts = next(text for text in found.texts if text.startswith('{"title"'))
        assert json.loads(facts)["title"] == title
        names.add(tuple(found.names))
        assert not set("<>&\u2028\u2029") & set(facts)
    assert len(names) == 1, "all pages have the same elements"
