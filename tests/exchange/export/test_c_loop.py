"""A loop with an estimator in C: step for step that of Python, also where readings fail; and what is refused."""

import math
import re
import shutil
import subprocess

import numpy as np
import pytest
import torch

import lyapnet
from lyapnet.base.errors import ExportError, UsageError
from lyapnet.cli import main
from lyapnet.exchange.export import c, export
from lyapnet.exchange.export.c import Bits, Style, library_of
from lyapnet.exchange.export.c_loop import CompiledLoop, LoopTraces
from lyapnet.experiment.assembly import Parts, build_problem
from lyapnet.experiment.config import config_from_plain
from lyapnet.graphs import c_rules
from lyapnet.task.systems import ControlAffineSystem, Pendulum
from lyapnet.value.expansions import riccati
from tests.marks import sample
from tests.problems import OfExpansion
from tests.runs import TINY, tiny_checkpoint

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")

TASK = {
    "experiment": "outputs",
    "system": {"name": "pendulum"},
    "cost": {"Q": [1, 0.1], "R": 0.1, "Q_T": [2, 1]},
    "initial_states": {"lower": -1, "upper": 1},
    "controls": {"lower": -0.7, "upper": 0.5},
    "horizon": {"steps": 20, "dt": 0.05},
    "outputs": {"measure": ["angle"], "noise": 0.01},
}


class Seen(Pendulum):
    """A pendulum of which a camera sees sine and cosine of the angle."""

    def output(self, x):
        return torch.stack([torch.sin(x[..., 0]), torch.cos(x[..., 0])], -1)


class Level(ControlAffineSystem):
    """One state, with names that end comments and strings."""

    state_names, state_units = ('*/ "level" \\ %d',), ("m",)
    control_names, control_units = ("pump */",), ("L/s",)

    def f(self, x):
        return -0.5 * torch.tanh(x)

    def g(self, x):
        return torch.ones(*x.shape, 1).to(x)


class Tanks(ControlAffineSystem):
    """Two tanks in a row, whose levels have a root and so a domain."""

    state_names, state_units = ("upper level", "lower level"), ("m", "m")
    control_names, control_units = ("pump",), ("L/s",)

    def f(self, x):
        flow = 0.0144 * torch.sqrt(x)
        return torch.stack([-flow[..., 0], flow[..., 0] - flow[..., 1]], -1)

    def g(self, x):
        return x.new_tensor([[0.065], [0.0]]).expand(*x.shape[:-1], 2, 1)


TANKS = {
    "cost": {"Q": [1, 10], "R": 1, "Q_T": [10, 100]},
    "target": {"lower level": 0.4},
    "controls": {"lower": 0, "upper": 0.3},
    "initial_states": {"lower": 0.1, "upper": 0.7},
    "horizon": {"steps": 60, "dt": 2.0},
    "outputs": {"measure": ["lower level"], "noise": 0.006, "input_disturbances": {"pump": 0.002}},
}


def controller_of(beyond="riccati", parts=None, **changes):
    """One with the V of the Riccati solution."""
    config = config_from_plain({**TASK, **changes})
    parts = parts or Parts()
    problem = build_problem(config, parts)
    V = OfExpansion(problem, riccati(problem)).to(problem.initial_states.lower.dtype)
    return lyapnet.Controller(problem, V, config=config, beyond=beyond, parts=parts)


SWING = {"controls": {"lower": -20, "upper": 20}}
LOOPS = {
    "a pendulum": lambda: controller_of().with_estimator(),
    "held after T": lambda: controller_of("hold").with_estimator(),
    "a disturbance": lambda: controller_of().with_estimator(input_disturbances={"torque": 0.1}),
    "parameters": lambda: controller_of(randomise={"length": [0.5, 1.5]}).with_estimator(),
    "noise, steps of fourth order": lambda: controller_of(
        noise={"velocity": 0.05}, rollout={"method": "rk4"}
    ).with_estimator(),
    "outputs of the system": lambda: controller_of(
        parts=Parts(system=Seen()), outputs={"noise": [0.01, 0.02]}
    ).with_estimator(),
    "settings": lambda: controller_of("hold", family={"target_angle": [-0.4, 0.4], "length": [0.9, 1.1]}, **SWING)
    .with_estimator(),
    "a delay": lambda: controller_of().with_estimator(delay=1),
    "a delay and settings": lambda: controller_of("hold", family={"target_angle": [-0.4, 0.4]}, **SWING)
    .with_estimator(input_disturbances={"torque": 0.1}, delay=3),
    "a domain": lambda: controller_of(parts=Parts(system=Tanks()), **TANKS).with_estimator(),
    "one state": lambda: controller_of(
        parts=Parts(system=Level()), cost={"Q": [1], "R": 0.1, "Q_T": [2]}, outputs={}
    ).with_estimator(measure=['*/ "level" \\ %d'], noise=0.02),
}  # fmt: skip


def compiled_loop(loop, folder, dtype="float64", name="lyapnet"):
    """The exported loop as machine code."""
    export(loop, folder, "c", dtype=dtype, name=name)
    style = Style(name, getattr(torch, dtype))
    return CompiledLoop(LoopTraces(loop), library_of([folder / "policy.c"], c.FLAGS), style)


@pytest.mark.gate
@pytest.mark.parametrize("kind", sample(LOOPS, 9))
def test_it_is_pythons_over_ten_thousand_steps(kind, tmp_path):
    loop = LOOPS[kind]()
    paths, agreement = export(loop, tmp_path / "loop", "c")
    assert [path.name for path in paths] == ["policy.h", "policy.c", "main.c", "CMakeLists.txt"]
    assert agreement.control < 1e-9
    assert (of_loop := agreement.loop) is not None
    assert of_loop.steps >= 10_000
    assert max(of_loop.control, of_loop.estimate, of_loop.covariance) < 1e-9
    header = (tmp_path / "loop" / "policy.h").read_text()
    assert str(of_loop) in header
    assert "X₀: " in header


@pytest.mark.gate
def test_one_long_run_is_pythons_too(tmp_path):
    loop = controller_of().with_estimator(input_disturbances={"torque": 0.1})
    found, draw = compiled_loop(loop, tmp_path / "loop"), np.random.default_rng(0)
    x = torch.tensor([0.8, -0.5], dtype=torch.float64)
    problem = loop.controller.problem
    u = np.zeros(1)
    for step in range(1000):
        y = x[:1].numpy() + 0.01 * draw.standard_normal(1)
        if step % 7 == 3:
            y[0] = math.nan
        u, own = loop.step(y), found.step(y)
        assert own == pytest.approx(u, rel=1e-9, abs=1e-9)
        assert found.code & ~Bits.OUTSIDE[0] == (Bits.MISSING[0] if step % 7 == 3 else 0)
        x = problem.step(x, torch.from_numpy(u) - 0.2)[0]
    assert found.x_hat == pytest.approx(loop.x_hat, rel=1e-9, abs=1e-9)
    assert found.memory.t == pytest.approx(loop.t, rel=1e-9)
    assert abs(loop.d_hat[0] + 0.2) < 0.1


@pytest.mark.gate
def test_what_was_applied_before_the_first_readings_has_no_meaning(tmp_path):
    """At rest acts then, as in Python, also with a delay."""
    loop = LOOPS["a delay"]()
    found = compiled_loop(loop, tmp_path / "loop")
    for _ in range(3):
        assert found.step(np.array([0.3]), np.array([5.0])) == pytest.approx(loop.step([0.3], applied=[5.0]), rel=1e-9)


@pytest.mark.gate
def test_a_setting_that_changes_begins_the_horizon_anew(tmp_path):
    loop = LOOPS["settings"]()
    found = compiled_loop(loop, tmp_path / "loop")
    for step, goal in enumerate([0.2, 0.2, 0.2, -0.3, -0.3, None, 0.1]):
        given = {} if goal is None else {"target_angle": goal}
        own = found.step(np.array([0.3]), r=None if goal is None else np.array([goal]))
        assert own == pytest.approx(loop.step([0.3], **given), rel=1e-9, abs=1e-9)
        assert found.memory.begun == {3: 3, 4: 3, 5: 3, 6: 6}.get(step, 0)
    before = found.x_hat[2]
    found.step(np.array([0.3]), r=np.array([0.5]))
    assert found.code & Bits.OUTSIDE[0], "outside of its range it stays"
    assert found.x_hat[2] == before == 0.1


@pytest.mark.gate
def test_readings_that_are_none_and_failures_are_told(tmp_path):
    found = compiled_loop(controller_of().with_estimator(), tmp_path / "loop")
    u = found.step(np.array([0.3]))
    assert found.code == 0
    for bad in (math.nan, math.inf, -math.inf):
        found.step(np.array([bad]))
        assert found.code == Bits.MISSING[0]
        assert np.isfinite(found.x_hat).all()
    x_hat, u = found.x_hat, found.step(np.array([0.2]))
    found.memory.x[0] = math.nan  # memory that was overwritten
    held = found.step(np.array([0.2]))
    assert found.code & Bits.NOT_FINITE[0]
    assert held == u
    found.reset()
    found.step(np.array([50.0]))
    assert found.code & Bits.OUTSIDE_X0[0] or abs(found.x_hat[0]) < 7, "an angle is compared modulo 2 pi"
    found.reset()
    found.memory.x[1] = 1e3
    found.step(np.array([0.2]))
    assert found.code == Bits.OUTSIDE[0] + Bits.OUTSIDE_X0[0]
    assert np.isfinite(x_hat).all()


@pytest.mark.gate
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_a_loop_says_while_a_parameter_is_at_an_end_of_its_range(dtype, tmp_path):
    """A plant of 3 m where 0.5 to 1.5 m are known; the code is there at the steps at which Python's name is."""
    loop = controller_of(randomise={"length": [0.5, 1.5]}, **SWING).with_estimator()
    found, bit, told = compiled_loop(loop, tmp_path / "loop", dtype), Bits.AT_RANGE_END[0], list[bool]()
    x = torch.tensor([0.5, 0.0, 3.0]).double()
    for _ in range(40):
        u = loop.step(x[:1].numpy())
        found.step(x[:1].numpy())
        told.append(bool(found.code & bit))
        assert told[-1] == (loop.at_range_end == ["length"])
        x = loop.problem.step(x, torch.from_numpy(u).double())[0]
    assert told[-1]
    assert not told[0]
    fixed = controller_of(**SWING).with_estimator()
    export(fixed, tmp_path / "fixed", "c")
    assert "code |= LYAPNET_AT_RANGE_END" not in (tmp_path / "fixed" / "policy.c").read_text()


@pytest.mark.gate
def test_a_loop_says_where_its_estimate_is_outside_of_the_domain(tmp_path):
    found = compiled_loop(LOOPS["a domain"](), tmp_path / "loop")
    for _ in range(3):
        found.step(np.array([0.4]))
        assert found.code == 0
    found.memory.x[1] = -0.2
    found.step(np.array([math.nan]))
    assert found.code == Bits.OUTSIDE[0] + Bits.OUTSIDE_DOMAIN[0] + Bits.MISSING[0]


@pytest.mark.gate
@pytest.mark.parametrize("bad", [1e200, 1e308])
def test_a_reading_that_breaks_the_numbers_does_not_break_the_loop(bad, tmp_path):
    loop = LOOPS["one state"]()
    found = compiled_loop(loop, tmp_path / "loop")
    u = found.step(np.array([0.1]))
    found.memory.P[0] = 1e308
    again = found.step(np.array([bad]))
    assert np.isfinite(again).all()
    assert np.isfinite(found.x_hat).all()
    assert -0.7 <= float(again[0]) <= 0.5
    assert -0.7 <= float(u[0]) <= 0.5


@pytest.mark.gate
def test_single_precision_is_near(tmp_path):
    loop = controller_of().with_estimator()
    of_loop = export(loop, tmp_path / "loop", "c", dtype="float32", name="arm").agreement.loop
    assert 1e-9 < max(of_loop.control, of_loop.estimate) < 1e-3
    code = (tmp_path / "loop" / "policy.c").read_text()
    assert "double" not in re.sub(r"\(double\)(loop->start|k|\(k - loop->begun\)) ", "", code), "but of time"
    assert "typedef float arm_real;" in (tmp_path / "loop" / "policy.h").read_text()
    found = compiled_loop(loop, tmp_path / "other", "float32")
    u = [float(found.step(np.array([y]))[0]) for y in (0.9, 0.9, -0.9, -0.9)]
    assert all(-0.7 <= each <= 0.5 for each in u), "limits are rounded inwards"


@pytest.mark.gate
def test_a_loop_that_is_not_pythons_is_not_kept(monkeypatch, tmp_path):
    right = c_rules.RULES["_linalg_solve_ex"]

    def wrong(text, A, B, **options):
        solution, *rest = right(text, A, B, **options)
        return [c_rules.RULES["mul"](text, solution, 1 + 1e-6), *rest]

    monkeypatch.setitem(c_rules.RULES, "_linalg_solve_ex", wrong)
    with pytest.raises(ExportError, match="Expected the loop's own u and estimate"):
        export(LOOPS["a pendulum"](), tmp_path / "loop", "c")
    assert not [*tmp_path.iterdir()]


def test_what_cannot_be_a_loop_in_c_is_refused(tmp_path):
    with pytest.raises(ExportError, match="ekf, got ukf"):
        export(controller_of().with_estimator("ukf"), tmp_path / "loop", "c")
    with pytest.raises(UsageError, match="Expected an estimator with --to c"):
        export(controller_of().with_estimator(), tmp_path / "loop.pt2", "torch")
    with pytest.raises(UsageError, match="dtype among float64, float32"):
        export(controller_of(), tmp_path / "loop", "c", dtype="float16")
    with pytest.raises(UsageError, match="Expected no dtype for torch"):
        export(controller_of(), tmp_path / "loop.pt2", "torch", dtype="float32")
    assert not [*tmp_path.iterdir()]


PLANT = """
#include <math.h>
#include <stdio.h>
#include "policy.h"
int main(void)
{
    double x[2] = {0.8, -0.5}, u[1];
    lyapnet_loop loop;
    lyapnet_reset(&loop);
    for (int k = 0; k < 400; k++) {
        lyapnet_step(&loop, x, u);
        double slope[2] = {x[1], GRAVITY * sin(x[0]) - FRICTION * x[1] + GAIN * u[0]};
        for (int i = 0; i < 2; i++) x[i] += 0.05 * slope[i];
    }
    printf("%.17g %.17g\\n", x[0], x[1]);
    return 0;
}
"""


@pytest.mark.gate
def test_a_plant_in_c_is_led_as_in_python(tmp_path):
    controller = controller_of()
    loop = controller.with_estimator()
    export(loop, tmp_path / "loop", "c")
    origin = torch.zeros(2, dtype=torch.float64)
    system = controller.system
    A = float(torch.autograd.functional.jacobian(system.f, origin)[1, 0])
    B = -float(torch.autograd.functional.jacobian(system.f, origin)[1, 1])
    (tmp_path / "plant.c").write_text(PLANT)
    defines = [
        f"-DGRAVITY={A!r}",
        f"-DFRICTION={B!r}",
        f"-DGAIN={float(system.g(origin)[1, 0])!r}",
        f"-I{tmp_path / 'loop'}",
    ]
    sources = [str(tmp_path / "plant.c"), str(tmp_path / "loop" / "policy.c")]
    program = str(tmp_path / "plant")
    subprocess.run(["cc", "-std=c99", "-O2", *defines, "-o", program, *sources, "-lm"], check=True)
    printed = subprocess.run([program], capture_output=True, text=True, check=True).stdout.split()
    x = torch.tensor([0.8, -0.5], dtype=torch.float64)
    for _ in range(400):
        u = loop.step(x[:1])
        x = controller.problem.step(x, u)[0]
    assert [float(each) for each in printed] == pytest.approx(x.tolist(), rel=1e-9, abs=1e-9)


@pytest.mark.gate
@pytest.mark.parametrize(("limit", "inside"), [(0.7, True), (1e-6, False)])
def test_the_example_prints_controls_within_their_limits_if_some_readings_lead_there(limit, inside, tmp_path):
    """From the middle of X₀, 3 rad from the goal, the first control is at its limit."""
    box = {"initial_states": {"lower": [-1, -1], "upper": [4, 1]}, "controls": {"lower": -limit, "upper": limit}}
    export(controller_of(**box).with_estimator(), tmp_path / "loop", "c")
    program = str(tmp_path / "main")
    sources = [str(tmp_path / "loop" / name) for name in ("main.c", "policy.c")]
    subprocess.run(["cc", "-std=c99", "-o", program, *sources, "-lm"], check=True)
    printed = subprocess.run([program], capture_output=True, text=True, check=True).stdout
    u = [abs(float(line.split(" = ")[1])) for line in printed.splitlines() if line.startswith("u[0]")]
    assert (max(u) < limit) == inside


@pytest.mark.gate
def test_the_law_is_written_once(tmp_path):
    """A loop calls the function of the law, and takes estimated disturbances off afterwards."""
    for name in ("a pendulum", "a disturbance"):
        export(LOOPS[name](), tmp_path / name, "c")
        code = (tmp_path / name / "policy.c").read_text()
        assert re.findall(r"^static void (\w+_of)\(", code, re.MULTILINE) == [
            "control_of", "value_of", "predict_of", "correct_of", *["take_off_of"] * (name == "a disturbance"),
        ]  # fmt: skip
        assert code.count("control_of(") == 3, "its definition, lyapnet_control and lyapnet_step"


@pytest.mark.gate
@pytest.mark.parametrize("measured", [True, False])
def test_a_training_prints_the_export_of_what_reads_its_outputs(measured, tmp_path, capsys):
    overrides = [
        *TINY,
        "network.hidden=[8]",
        "rollout.gradient=backprop",
        f"logs={tmp_path / 'logs'}",
        "experiment=tiny",
    ]
    overrides += ["outputs={measure: [position], noise: 0.01}"] if measured else []
    assert main(["train", "--config", "conf/from_scratch/double_integrator.yaml", *overrides]) == 0
    (line,) = [each for each in capsys.readouterr().out.splitlines() if each.startswith("export ")]
    assert line.endswith("--to c --out law --estimator ekf") == measured
    checkpoint = tmp_path / "logs" / "tiny" / "version_0" / "checkpoints" / "best.ckpt"
    given = ["export", str(checkpoint), "--to", "c", "--out", str(tmp_path / "law")]
    assert main(given) == 0
    assert ("note: the law alone, of the state; --estimator ekf" in capsys.readouterr().out) == measured
    if measured:
        assert main([*given, "--estimator", "ekf"]) == 0
        assert "note: the law alone" not in capsys.readouterr().out


@pytest.mark.gate
def test_the_command_writes_a_loop(tmp_path, capsys):
    checkpoint, folder = tiny_checkpoint(tmp_path), tmp_path / "loop"
    given = ["export", str(checkpoint), "--to", "c", "--out", str(folder), "--beyond", "hold"]
    assert main([*given, "--outputs", "position=0.01"]) == 2
    assert "add --estimator ekf" in capsys.readouterr().err
    assert main([*given, "--estimator", "ekf"]) == 2
    assert "--outputs" in capsys.readouterr().err
    assert main([*given, "--estimator", "ekf", "--outputs", "position=0.01", "--dtype", "float32"]) == 0
    printed = capsys.readouterr().out
    assert "steps of closed loops u is within" in printed
    header = (folder / "policy.h").read_text()
    assert str(tmp_path) not in header
    assert "y: position ± 0.01 m" in header
    program = str(tmp_path / "main")
    command = ["cc", "-std=c99", "-o", program, str(folder / "main.c"), str(folder / "policy.c"), "-lm"]
    subprocess.run(command, check=True)
    assert subprocess.run([program], capture_output=True, text=True, check=True).stdout.count("u[0] = ") == 5
