"""The law as a CasADi function: its values and derivatives, and V as a terminal cost in plain CasADi."""

import re
import sys

import numpy as np
import pytest
import torch

import lyapnet
from lyapnet.base.errors import ExportError
from lyapnet.exchange.export import export
from tests.pages import ROOT

casadi = pytest.importorskip("casadi")


@pytest.mark.gate
@pytest.mark.parametrize("name", ["double_integrator", "pendulum_limited", "reacher_family"])
def test_values_and_the_derivative_of_v(name, tmp_path):
    controller = lyapnet.load(f"zoo:{name}")
    path = tmp_path / "law.casadi"
    (written,), agreement = export(controller, path, "casadi")
    assert written == path
    assert max(agreement.control, agreement.value) < 1e-12
    law = casadi.Function.load(str(path))
    z = controller.initial_states.sample(5, torch.Generator().manual_seed(0)).double()
    n = law.size1_in("x")
    for row in z:
        given = {"t": 0.3, "x": row[:n].numpy(), **({"p": row[n:].numpy()} if n < len(row) else {})}
        found = law(**given)
        t, x = torch.full((1,), 0.3, dtype=torch.float64), row[None].clone().requires_grad_()
        (gradient,) = torch.autograd.grad(controller.V(t, x).sum(), x)
        np.testing.assert_allclose(np.asarray(found["V_x"]).ravel(), gradient[0, :n].numpy(), rtol=1e-9, atol=1e-9)
        with torch.no_grad():
            u = controller.law.at_any_time(t, row[None])[0]
        np.testing.assert_allclose(np.asarray(found["u"]).ravel(), u.numpy(), rtol=1e-9, atol=1e-9)


def test_without_casadi_one_line_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "casadi", None)
    with pytest.raises(ExportError, match=r"pip install 'lyapnet\[oracle\]'"):
        export(lyapnet.load("zoo:double_integrator"), tmp_path / "law.casadi", "casadi")


@pytest.mark.gate
def test_the_example_of_the_page_plans_the_controls_of_the_law(tmp_path, monkeypatch, capsys):
    page = (ROOT / "docs" / "export.md").read_text(encoding="utf-8")
    (example,) = [block for block in re.findall(r"```python\n(.*?)```", page, re.S) if "casadi.Opti()" in block]
    monkeypatch.chdir(tmp_path)
    export(lyapnet.load("zoo:double_integrator"), tmp_path / "double_integrator.casadi", "casadi")
    exec(compile(example, "docs/export.md", "exec"), {})
    planned, law = (float(word.strip("[]")) for word in capsys.readouterr().out.split()[-2:])
    assert planned == pytest.approx(law, rel=2e-2)
