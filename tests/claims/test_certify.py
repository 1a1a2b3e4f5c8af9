"""lyapnet.certify: combinations of claims, the resources that each can use, and agreement of docs and fields."""

import dataclasses
import re

import pytest
import torch

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.claims.claim import flags_of
from tests.claims.planted import problem, riccati, stationary
from tests.pages import PAGES, ROOT

KINDS = (
    lyapnet.Sampled, lyapnet.Statistical, lyapnet.Funnel, lyapnet.NoisyFunnel, lyapnet.Reach, lyapnet.LowerBound,
    lyapnet.Region,
    lyapnet.Tube,
)  # fmt: skip
FROM_PYTHON = PAGES[ROOT / "docs" / "from_python.md"]


@pytest.fixture
def controller():
    torch.set_default_dtype(torch.float64)
    return lyapnet.Controller(problem(), stationary(riccati()))


@pytest.mark.parametrize(
    ("claims", "message"),
    [
        ([], "Expected one claim, or a funnel or a tube and a LowerBound, got none"),
        ([lyapnet.Funnel(), lyapnet.Tube()], "got sound and tube; call certify for each of them"),
        ([lyapnet.Sampled(), lyapnet.LowerBound()], "got sampled and lower"),
        ([lyapnet.LowerBound(), lyapnet.LowerBound()], "got lower and lower"),
        ([lyapnet.Funnel(alpha=0.9), lyapnet.LowerBound(beta=0.8)], "Expected the beta of the sound claim beside it"),
        ([lyapnet.Funnel(delta=0.1), lyapnet.LowerBound(delta=0.2)], "Expected the delta of the sound claim beside it"),
    ],
)
def test_claims_that_do_not_go_together_are_refused(controller, claims, message):
    with pytest.raises(UsageError, match=message):
        lyapnet.certify(controller, *claims)


@pytest.mark.parametrize("claim", [lyapnet.Tube(), lyapnet.Sampled()])
def test_a_file_for_what_keeps_no_proof_is_refused(controller, claim, tmp_path):
    with pytest.raises(UsageError, match="Expected no keep for a"):
        lyapnet.certify(controller, claim, keep=tmp_path / "proof")
    with pytest.raises(UsageError, match="Expected no ray for a"):
        lyapnet.certify(controller, claim, budget=lyapnet.Budget(10, ray="local"))


@pytest.mark.gate
def test_two_sides_in_any_order_are_one_certificate(controller):
    claims = [lyapnet.LowerBound(), lyapnet.Funnel(alpha=0.9, delta=0.1)]
    both = lyapnet.certify(controller, *claims)
    assert both.result["lower_level"] > 0
    assert "--two-sided" in both.command("best.ckpt")
    alone = lyapnet.certify(controller, lyapnet.LowerBound(beta=0.9, delta=0.1))
    assert alone.result["lower_level"] == both.result["lower_level"]
    assert alone.in_words().startswith("controls that keep the state in D cost at least")
    assert alone.figure().axes


@pytest.mark.parametrize("kind", KINDS)
def test_options_are_dataclass_fields_with_a_sentence(kind):
    for f in dataclasses.fields(kind):
        assert f.metadata["doc"].endswith(".")
    assert kind().options.keys() == dict(flags_of(kind)).keys()


@pytest.mark.parametrize("kind", KINDS)
def test_the_page_lists_the_fields(kind):
    (row,) = re.findall(rf"^\| `{kind.__name__}` \| (.*?) \|", FROM_PYTHON, flags=re.MULTILINE)
    assert re.findall(r"`(\w+)`", row) == [f.name for f in dataclasses.fields(kind)]


@pytest.mark.parametrize(
    ("kind", "page", "section"),
    [
        (lyapnet.Funnel, "funnels", "# Funnels"),
        (lyapnet.NoisyFunnel, "noisy_certificates", "# Under noise"),
        (lyapnet.Reach, "noisy_certificates", "## Reaching a target"),
        (lyapnet.Region, "regions", "# Region of attraction"),
    ],
)
def test_the_tables_of_options_have_the_fields(kind, page, section):
    text = PAGES[ROOT / "docs" / f"{page}.md"].partition(f"{section}\n")[2]
    table = text[text.index("| option |") :].partition("\n\n")[0]
    assert dict(flags_of(kind)).keys() <= set(re.findall(r"`--([a-z-]+)", table))


@pytest.mark.gate
def test_the_example_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (example,) = re.findall(r"## Certify, evaluate, export\n\n```python\n(.*?)```", FROM_PYTHON, flags=re.DOTALL)
    names: dict = {}
    exec(example, names)
    assert names["certificate"].kind == "statistical"
    assert "statistical: " in capsys.readouterr().out
    assert "double_integrator" in (tmp_path / "report" / "report.md").read_text(encoding="utf-8")
    assert (tmp_path / "law" / "policy.c").exists()
