"""What is exported says what the controller says, in each language, without lyapnet; and nothing else is kept."""

import json
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
import torch

import lyapnet
from lyapnet.base.errors import ExportError, UsageError
from lyapnet.base.files import digest_of_file
from lyapnet.cli import main
from lyapnet.controller.controller import Controller
from lyapnet.exchange.export import compiled, export
from lyapnet.exchange.export.c import FLAGS, Bits, CompiledLaw, Style
from lyapnet.exchange.export.law import Law
from lyapnet.exchange.export.verification import STATES, points
from lyapnet.graphs import c_rules
from lyapnet.task.sets import ControlBox
from lyapnet.task.systems import ControlAffineSystem
from tests.marks import sample
from tests.problems import Formula, problem_of, untrained
from tests.runs import tiny_checkpoint

needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
SHORT = ("horizon.steps=12", "network.hidden=[8,8]")
KINDS = {
    "the HJB law": ("double_integrator", ()),
    "Sontag's formula": ("double_integrator", ("rollout.policy=sontag",)),
    "a limit, held": ("pendulum_limited", ()),
    "limits on one side": ("reacher", ("controls.lower=[-0.4]", "controls.upper=[null,0.4]")),
    "two limits, R(x) full": ("reacher", ("controls.lower=[-1,-0.4]", "controls.upper=[1,0.4]")),
    "limits of four controls": ("quadrotor", ("controls.lower=-1", "controls.upper=2")),
    "a law that looks ahead": ("keep_out", ()),
    "a family": ("cartpole_family", ()),
    "a target, steps of fourth order": ("pendulum_swingup", ("target=[0.5,0]", "rollout.method=rk4")),
}  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def _few_steps():
    """Of a law that looks ahead, each of which is traced and written."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lyapnet.value.policy.DESCENTS_WITH_CONSTRAINTS", 2)
        yield


def controller_of(kind, beyond=None, more=()):
    """A controller with random weights; none of them zero."""
    name, overrides = KINDS[kind]
    controller = untrained(name, *SHORT, *overrides, *more)
    with torch.no_grad():
        for parameter in controller.V.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    return controller if beyond is None else controller.continued(beyond)


def answers_of_main(folder):
    """(u, V) that the example in a folder prints."""
    program = folder / "main"
    command = ["cc", "-std=c99", "-o", str(program), str(folder / "main.c"), str(folder / "policy.c"), "-lm"]
    subprocess.run(command, check=True)
    printed = subprocess.run([str(program)], capture_output=True, text=True, check=True).stdout.split("\n")
    *u, V = [float(line.partition("=")[2]) for line in printed if line]
    return u, V


@pytest.mark.gate
@needs_compiler
@pytest.mark.parametrize("kind", sample(KINDS, 9))
def test_c_says_what_the_controller_says(kind, tmp_path):
    controller = controller_of(kind)
    paths, agreement = export(controller, tmp_path / "law", "c")
    assert [path.name for path in paths] == ["policy.h", "policy.c", "main.c", "CMakeLists.txt"]
    assert agreement.states == STATES
    assert max(agreement.control, agreement.value) < (1e-6 if "ahead" in kind else 1e-9)
    u, V = answers_of_main(tmp_path / "law")
    x = (controller.initial_states.center + controller.initial_states.upper) / 2
    assert u == pytest.approx(controller.policy(0.0, x).tolist(), rel=1e-4, abs=1e-6)
    assert pytest.approx(float(controller.value(0.0, x)), rel=1e-4, abs=1e-6) == V
    assert ("PARAMETERS" in (tmp_path / "law" / "policy.h").read_text()) == (kind == "a family")


@pytest.mark.gate
@needs_compiler
@pytest.mark.parametrize("kind", ["a limit, held", "a family"])
def test_in_python_it_is_one_state_after_another(kind):
    controller = controller_of(kind)
    law = compiled(controller)
    x = controller.initial_states.upper
    assert law.policy(0.2, x.tolist()) == pytest.approx(controller.policy(0.2, x.numpy()), rel=1e-9)
    assert law.value(0.2, x.numpy()) == pytest.approx(float(controller.value(0.2, x)), rel=1e-9)
    assert law.policy(-1.0, x.numpy()) == pytest.approx(controller.policy(0.0, x.numpy()), rel=1e-9)
    with pytest.raises(ValueError, match="one state"):
        law.policy(0.0, [[0.0] * len(x)])
    with pytest.raises(ValueError, match="one state"):
        law.value(0.0, [0.0] * (len(x) - 1))


@pytest.mark.gate
@needs_compiler
def test_a_code_says_where_the_law_was_not_compared():
    controller = controller_of("a limit, held")
    law, x0 = compiled(controller), controller.initial_states.upper
    loop = controller.rollout(x0[None])
    codes = [law.policy_and_code(float(t), x)[1] for t, x in zip(loop.t, loop.x[:, 0].numpy(), strict=True)]
    assert not any(codes), "closed loops from X₀ are within"
    far = (x0 + 1e3).tolist()
    assert law.policy_and_code(0.1, far)[1] == Bits.OUTSIDE[0]
    assert law.policy_and_code(0.0, far)[1] == Bits.OUTSIDE[0] + Bits.OUTSIDE_X0[0]
    u, code = law.policy_and_code(0.1, [float("nan")] * len(x0))
    assert code == Bits.OUTSIDE[0] + Bits.NOT_FINITE[0]
    assert np.isnan(u).any()


@needs_compiler
@pytest.mark.parametrize("beyond", ["hold", "receding", "riccati"])
def test_what_follows_T_is_inside(beyond, tmp_path):
    controller = controller_of("the HJB law", beyond)
    _, agreement = export(controller, tmp_path / "law", "c")
    t, *_ = points(controller)
    assert (t > controller.horizon.duration).any(), "they are among the states that it is held against"
    assert agreement.control < 1e-9
    assert beyond in (tmp_path / "law" / "policy.h").read_text()


@needs_compiler
@pytest.mark.parametrize("rule", ["mul", "sigmoid", "mm"])
def test_a_law_that_is_not_the_controllers_is_not_kept(rule, monkeypatch, tmp_path):
    right = c_rules.RULES[rule]
    wrong = lambda text, *values: c_rules.RULES["add"](text, right(text, *values), 1e-6)  # noqa: E731
    monkeypatch.setitem(c_rules.RULES, rule, wrong)
    with pytest.raises(ExportError, match="Expected the controller's own u and V"):
        export(controller_of("a limit, held"), tmp_path / "law", "c")
    assert not [*tmp_path.iterdir()]


@needs_compiler
def test_limits_hold_to_the_last_bit(tmp_path):
    controller = controller_of("a limit, held")
    export(controller, tmp_path / "law", "c")
    t, x, *_ = points(controller)
    u = controller.policy(t, x)
    assert (u.abs() == 8).any()
    assert "larger(" in (text := (tmp_path / "law" / "policy.c").read_text())
    assert "8.0" in text


@pytest.mark.gate
def test_torchs_program_runs_without_lyapnet(tmp_path):
    controller = controller_of("two limits, R(x) full")
    _, agreement = export(controller, tmp_path / "law.pt2", "torch")
    assert max(agreement.control, agreement.value) < 1e-9
    script = (
        "import json, sys, torch\nabout = {'lyapnet.json': ''}\n"
        f"law = torch.export.load({str(tmp_path / 'law.pt2')!r}, extra_files=about).module()\n"
        "u, V = law(torch.tensor(0.1, dtype=torch.float64), torch.tensor([0.1, -0.2, 0.3, 0.0], dtype=torch.float64))\n"
        "print(json.dumps([u.tolist(), V.item(), json.loads(about['lyapnet.json']), 'lyapnet' in sys.modules]))\n"
    )
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", script], capture_output=True, text=True, check=True)
    u, V, about, loaded = json.loads(done.stdout)
    x = torch.tensor([0.1, -0.2, 0.3, 0.0])
    assert u == pytest.approx(controller.policy(0.1, x).tolist(), rel=1e-9)
    assert pytest.approx(float(controller.value(0.1, x)), rel=1e-9) == V
    assert str(agreement) == about["verified"]
    assert not loaded


@pytest.mark.gate
@pytest.mark.parametrize("kind", ["a limit, held", "a family"])
def test_onnx_says_what_the_controller_says(kind, tmp_path):
    pytest.importorskip("onnxscript")
    onnx, onnxruntime = pytest.importorskip("onnx"), pytest.importorskip("onnxruntime")
    controller = controller_of(kind)
    _, agreement = export(controller, tmp_path / "law.onnx", "onnx")
    assert max(agreement.control, agreement.value) < 1e-9
    model = onnx.load(tmp_path / "law.onnx")
    assert {entry.key: entry.value for entry in model.metadata_props}["verified"] == str(agreement)
    names = ["t", "x", "p"] if kind == "a family" else ["t", "x"]
    assert [given.name for given in model.graph.input] == names
    session = onnxruntime.InferenceSession(str(tmp_path / "law.onnx"))
    centre, n = controller.initial_states.center.numpy(), controller.system.n - len(controller.system.constants)
    u, V = session.run(["u", "V"], dict(zip(names, (np.array(0.3), centre[:n], centre[n:]), strict=False)))
    assert u == pytest.approx(controller.policy(0.3, centre), rel=1e-9)
    assert pytest.approx(controller.value(0.3, centre), rel=1e-9) == V


class Reading(ControlAffineSystem):
    """Its g reads values."""

    state_names, state_units = ("*/ int main(void) { return 1; } /*",), ("m",)
    control_names, control_units = ("u",), ("",)

    def __init__(self, reads=True):
        super().__init__()
        self.reads = reads

    def f(self, x):
        return 2 * torch.sin(x)

    def g(self, x):
        return (-1 if self.reads and float(x.sum()) > 9 else 1) * torch.ones(*x.shape, 1).to(x)


def own_controller(V=lambda t, x: (x**2).sum(-1) * (1 + t), **options):
    return Controller(problem_of(Reading(**options), controls=ControlBox([-1.0], [1.0])), Formula(V))


OWN = {
    "a square": lambda t, x: (x**2).sum(-1) * (1 + t),
    "a tangent": lambda t, x: torch.tan(0.1 * x[..., 0]) ** 2 * (1 + t),
    "a part of an axis": lambda t, x: (torch.cat([x, x], -1)[..., 1:] ** 2).sum(-1) * (1 + t),
    "no time": lambda t, x: (x**2).sum(-1),
    "numbers": lambda t, x: torch.remainder(x[..., 0], 0.7) * x[..., 0] * (1 + t) + torch.full_like(x[..., 0], 0.1),
}


@needs_compiler
@pytest.mark.parametrize("name", sample(OWN, 6))
@pytest.mark.parametrize("to", ["c", "torch", "onnx"])
def test_networks_of_ones_own(name, to, tmp_path):
    if to == "onnx":
        pytest.importorskip("onnxscript")
    controller = own_controller(OWN[name], reads=False)
    path, agreement = export(controller, tmp_path / {"c": "law", "torch": "law.pt2", "onnx": "law.onnx"}[to], to)
    assert path
    assert max(agreement.control, agreement.value) < 1e-12


@needs_compiler
def test_single_precision_is_exported_too(tmp_path):
    controller = untrained("double_integrator", *SHORT, "training.precision=float32")
    _, agreement = export(controller, tmp_path / "law", "c")
    assert max(agreement.control, agreement.value) < 1e-4


LIMITS = ("controls.lower=-0.1", "controls.upper=0.3")  # which no float is


@pytest.mark.gate
@needs_compiler
@pytest.mark.parametrize("kind", ["a limit, held", "a family", "limits of four controls"])
def test_numbers_in_c_may_be_floats(kind, tmp_path):
    controller = controller_of(kind, more=LIMITS)
    _, agreement = export(controller, tmp_path / "law", "c", dtype="float32", name="arm")
    assert 1e-9 < max(agreement.control, agreement.value) < 1e-3
    code = (tmp_path / "law" / "policy.c").read_text().split("*/", 1)[1]
    assert not re.findall(r"\bdouble\b|\d\.\d+(?![\df e])|\b(?:sin|cos|exp|sqrt)\(", code)
    law = CompiledLaw(tmp_path / "law", Law(controller), controller.system.m, FLAGS, Style("arm", torch.float32))
    for far in (-10, -1, 1, 10):
        u = law.policy(0.0, far * controller.initial_states.upper.numpy()).astype(float)
        assert (u >= -0.1).all()
        assert (u <= 0.3).all()


@needs_compiler
def test_files_of_the_users_own_are_kept(tmp_path):
    controller = own_controller(OWN["no time"], reads=False)
    folder = tmp_path / "law"
    export(controller, folder, "c")
    (folder / "main.c").write_text("mine")
    before = (folder / "policy.c").stat().st_mtime_ns
    paths, _ = export(controller, folder, "c")
    assert (folder / "main.c").read_text() == "mine"
    assert (folder / "policy.c").stat().st_mtime_ns > before
    assert [path.name for path in paths] == ["policy.h", "policy.c"]
    (folder / "policy.h").write_text("mine")
    with pytest.raises(UsageError, match="new folder"):
        export(controller, folder, "c")
    assert (folder / "policy.h").read_text() == "mine"


BOTH = """#include <stdio.h>
#include "{0}/policy.h"
#include "{1}/policy.h"
int main(void)
{{
    const double x[{2}_STATES] = {{0.3, -0.2}};
    printf("%.17g %.17g\\n", {3}_value(0.0, x), {4}_value(0.0, x));
    return 0;
}}
"""


@pytest.mark.gate
@needs_compiler
def test_one_program_has_several_laws_by_name(tmp_path):
    controllers = {name: untrained("double_integrator", *SHORT, f"seed={k}") for k, name in enumerate(("arm", "leg"))}
    for name, controller in controllers.items():
        export(controller, tmp_path / name, "c", name=name)
    assert "add_library(arm_policy policy.c)" in (tmp_path / "arm" / "CMakeLists.txt").read_text()
    done = built_together(tmp_path, "arm", "leg", "ARM", "arm", "leg")
    assert not done.returncode, done.stderr
    printed = subprocess.run([str(tmp_path / "both")], capture_output=True, text=True, check=True).stdout.split()
    values = [float(controller.value(0.0, [0.3, -0.2])) for controller in controllers.values()]
    assert [float(V) for V in printed] == pytest.approx(values, rel=1e-9)
    for name, controller in controllers.items():
        export(controller, tmp_path / f"{name}_too", "c")
    with pytest.raises(UsageError, match="a name as in"):
        export(controllers["leg"], tmp_path / "arm", "c", name="leg")
    again = built_together(tmp_path, "arm_too", "leg_too", "LYAPNET", "lyapnet", "lyapnet")
    assert "lyapnet_control" in again.stderr, "by one name they are defined twice"


def built_together(folder, *names):
    """What the compiler says to a program that asks two laws."""
    (folder / "both.c").write_text(BOTH.format(*names))
    sources = [str(folder / "both.c"), *(str(folder / name / "policy.c") for name in names[:2])]
    command = ["cc", "-std=c99", f"-I{folder}", "-o", str(folder / "both"), *sources, "-lm"]
    return subprocess.run(command, check=False, capture_output=True, text=True)


@pytest.mark.parametrize(("name", "to"), [("Arm", "c"), ("4bar", "c"), ("a-b", "c"), ("", "c"), ("arm", "torch")])
def test_a_name_that_is_none_is_refused(name, to, tmp_path):
    place = tmp_path / ("law" if to == "c" else "law.pt2")
    with pytest.raises(UsageError, match=r"Expected (a|no) name"):
        export(own_controller(reads=False), place, to, name=name)
    assert not place.exists()


@needs_compiler
def test_names_do_not_get_out_of_their_comment(tmp_path):
    export(own_controller(reads=False), tmp_path / "law", "c")
    u, _ = answers_of_main(tmp_path / "law")
    assert u == [-0.5]


@pytest.mark.parametrize(
    ("make", "name", "to", "error", "message"),
    [
        (own_controller, "law", "c", ExportError, "reads the values"),
        (lambda: controller_of("the HJB law", "error"), "law", "c", ExportError, "beyond=error"),
        (
            lambda: controller_of("the HJB law"),
            "law",
            "fortran",
            UsageError,
            "Expected a format among c, fmu, onnx, torch",
        ),
        (lambda: controller_of("the HJB law"), "law.bin", "torch", UsageError, "ends in .pt2"),
        (lambda: controller_of("the HJB law"), "none/law", "c", UsageError, "folder that exists"),
        (lambda: controller_of("the HJB law"), "file", "c", UsageError, "Expected a folder for c"),
    ],
)
def test_what_cannot_be_exported_is_refused(make, name, to, error, message, tmp_path):
    (tmp_path / "file").write_text("kept")
    with pytest.raises(error, match=message):
        export(make(), tmp_path / name, to)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    assert (tmp_path / "file").read_text() == "kept"


@pytest.mark.gate
def test_what_onnxruntime_lacks_is_named(tmp_path):
    pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    controller = own_controller(lambda t, x: torch.atan(x[..., 0] ** 2) * (1 + t), reads=False)
    with pytest.raises(ExportError, match=r"onnxruntime .* has in float64, got Atan.*--to c"):
        export(controller, tmp_path / "law.onnx", "onnx")
    assert not [*tmp_path.iterdir()]


def test_without_a_compiler_or_onnx_it_says_what_to_do(monkeypatch, tmp_path):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(ExportError, match="Expected a C compiler"):
        export(controller_of("the HJB law"), tmp_path / "law", "c")
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ExportError, match=r"pip install 'lyapnet\[onnx\]'"):
        export(controller_of("the HJB law"), tmp_path / "law.onnx", "onnx")
    assert not [*tmp_path.iterdir()]


@pytest.mark.gate
@needs_compiler
def test_the_command(tmp_path, capsys):
    checkpoint = tiny_checkpoint(tmp_path)
    capsys.readouterr()
    assert main(["export", str(checkpoint), "--to", "c", "--out", str(tmp_path / "law"), "--beyond", "receding"]) == 0
    printed = capsys.readouterr().out
    assert f"wrote {tmp_path / 'law' / 'policy.c'}" in printed
    assert "on 10000 states u is within" in printed
    header = (tmp_path / "law" / "policy.h").read_text()
    assert digest_of_file(checkpoint) in header
    assert "receding" in header
    assert "after T follows" not in printed
    assert main(["export", str(checkpoint), "--to", "c", "--out", str(tmp_path / "law")]) == 0
    found = lyapnet.load(checkpoint).after_horizon()
    assert f"law: after T follows {found.beyond} (" in capsys.readouterr().out
    assert f"after that {found.beyond}" in (tmp_path / "law" / "policy.h").read_text()
    assert "position (m), velocity (m/s)" in header
    assert main(["export", str(checkpoint), "--to", "cobol", "--out", str(tmp_path / "law")]) == 2
    assert "Expected a format among" in capsys.readouterr().err
    u, _ = answers_of_main(tmp_path / "law")
    assert u == pytest.approx(lyapnet.load(checkpoint).policy(0.0, [0.5, 0.35]).tolist(), rel=1e-4)
