"""What the README and the pages under docs/ link, show and name: all of it is there, and nothing is forgotten."""

import dataclasses
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import pytest
import yaml
from omegaconf import MISSING

from lyapnet.base import errors
from lyapnet.cli import main
from lyapnet.experiment.assembly import REGISTRIES
from lyapnet.experiment.config import Config
from lyapnet.experiment.recipe import STANDARD
from lyapnet.lab.comparison.plan import ComparisonConfig
from lyapnet.loop.programs import PROGRAMS
from lyapnet.value.networks import NETWORKS
from tests.pages import NOTEBOOKS, PAGES, README, REPORT, ROOT, prose_of

WIDTH = 120
FENCED = re.compile(r"^```.*?^```$", flags=re.DOTALL | re.MULTILINE)


def test_the_readme_is_short():
    lines = PAGES[README].splitlines()
    assert len(lines) < 200
    assert not [line for line in lines if len(line) > WIDTH]


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_prose_is_wrapped(page):
    """Commands too; only a table, or an address that has no blank, may be longer."""
    long = [line for line in PAGES[page].splitlines() if len(line) > WIDTH and " " in line and not line.startswith("|")]
    assert not long


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_no_merge_is_left_half_done(page):
    assert not re.search(r"^(<<<<<<<|=======|>>>>>>>)( |$)", PAGES[page], re.MULTILINE)


def without_code(text: str) -> str:
    return re.sub(r"`[^`]*`", "", FENCED.sub("", text))


def targets(page: Path) -> list[str]:
    """Where the links and pictures of a page lead, other sites aside."""
    found = re.findall(r"\]\(([^)\s]+)\)", without_code(prose_of(page)))
    return [target for target in found if not target.startswith(("https://", "http://"))]


def anchors(page: Path) -> set[str]:
    """The sections of a page as Git hosts name them in addresses."""
    headings = re.findall(r"^#+ (.*)$", FENCED.sub("", prose_of(page)), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", [*PAGES, REPORT, *NOTEBOOKS], ids=lambda path: path.name)
def test_links_resolve(page):
    for target in targets(page):
        place, _, anchor = target.partition("#")
        path = (page.parent / place).resolve() if place else page
        assert path.exists(), target
        assert path.is_relative_to(ROOT), target
        assert not anchor or anchor in anchors(path), target


def test_a_wrong_anchor_is_found():
    assert "certify" not in anchors(README)
    assert "how-the-bounds-were-examined" in anchors(ROOT / "docs" / "proofs.md")


def test_every_page_is_reached_from_the_readme():
    reached, waiting = set(), [README]
    while waiting:
        page = waiting.pop()
        if page not in reached:
            reached.add(page)
            linked = [(page.parent / target.partition("#")[0]).resolve() for target in targets(page)]
            waiting += [path for path in linked if path.suffix in (".md", ".ipynb")]
    assert reached >= {*ROOT.glob("docs/**/*.md"), *NOTEBOOKS}


def pictures(page: Path) -> list[Path]:
    found = re.findall(r"!\[[^]]*\]\(([^)]+)\)", page.read_text(encoding="utf-8"))
    return [(page.parent / picture).resolve() for picture in found]


def test_every_picture_is_on_one_page():
    shown = [picture for page in (*PAGES, *ROOT.glob("docs/tutorials/*.md")) for picture in pictures(page)]
    assert all(picture.is_file() for picture in shown)
    assert len(shown) == len(set(shown))
    assert {*shown, *pictures(REPORT)} == {*ROOT.glob("docs/**/*.png"), *ROOT.glob("docs/**/*.gif")}


@pytest.mark.parametrize("page", [page for page in PAGES if pictures(page)], ids=lambda path: path.name)
def test_every_picture_has_the_command_that_made_it(page):
    for caption in re.findall(r"!\[[^]]*\]\([^)]+\)\n\n(.*?)\n\n", PAGES[page] + "\n\n", flags=re.DOTALL):
        assert re.fullmatch(r"\*.*`(lyapnet|python\s+train\.py)\s.*`.*\*", caption.strip(), flags=re.DOTALL), caption
    assert len(re.findall(r"\)\n\n\*", PAGES[page])) >= len(pictures(page))


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_files_that_are_named_exist(page):
    named = re.findall(r"(?<![\w/])(?:conf|docs|tests)/[\w/.]*\w(?:\.\w+)?", PAGES[page])
    assert not [name for name in named if not (ROOT / name).exists()]


def keys_of(schema: Any, prefix: str = "") -> Iterator[tuple[str, dataclasses.Field]]:
    """Full name and field of every key, those of an entry under NAME."""
    for field in dataclasses.fields(schema):
        entries = [a for a in get_args(field.type) if dataclasses.is_dataclass(a)]
        if dataclasses.is_dataclass(field.type):
            yield from keys_of(field.type, f"{prefix}{field.name}.")
        else:
            yield prefix + field.name, field
        for entry in entries:
            yield from keys_of(entry, f"{prefix}{field.name}.NAME.")


SECTIONS = {field.name for field in dataclasses.fields(Config)}
KNOWN = dict(keys_of(Config))


def is_key(name: str) -> bool:
    """Whether the config has a key or a section of that name; what a section leaves open, it has."""
    parts = ("system", "cost", "controls", "program")
    open_ended = (
        "trainer",
        "family",
        "noise",
        "outputs.process_noise",
        "randomise",
        "target",
        *(f"{part}.parameters" for part in parts),
    )
    weight = re.fullmatch(r"family\.cost\.(Q|R|Q_T)\.\w+", name) is not None
    return name in {*KNOWN, *SECTIONS} or name.rpartition(".")[0] in open_ended or weight


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_keys_that_are_named_exist(page):
    """In a sentence as `section.key` or `section.key=value`, and in a YAML block or a mapping within a sentence."""
    code = re.findall(r"`([^`\n]+)`", FENCED.sub("", PAGES[page]))
    dotted = [match[1] for c in code if (match := re.fullmatch(r"([a-z_]+(?:\.\w+)+)(?:=.*)?", c))]
    named = [name for name in dotted if name.partition(".")[0] in SECTIONS and not name.endswith((".py", ".json"))]
    mappings = [c for c in code if re.match(r"[a-z_]+: [{\[]", c)]
    for source in [*mappings, *re.findall(r"```yaml\n(.*?)```", PAGES[page], re.DOTALL)]:
        content = yaml.safe_load(source.replace("module:Class", "own"))
        if "comparison" not in content:
            named += list(leaves(content))
    assert not [name for name in named if not is_key(name)]


def leaves(content: dict[str, Any], prefix: str = "") -> Iterator[str]:
    for key, value in content.items():
        if isinstance(value, dict) and f"{prefix}{key}" in SECTIONS:
            yield from leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}"


def test_a_wrong_key_is_found():
    assert not is_key("program.tirminal")
    assert is_key("trainer.devices")


def shown_default(field: dataclasses.Field) -> Any:
    """A default as the table has it, read as YAML; "–" where a file has to say it."""
    default = field.default if field.default_factory is dataclasses.MISSING else field.default_factory()
    return "–" if default == MISSING else default


@pytest.mark.parametrize(
    ("schema", "heading", "end"),
    [(Config, "## The experiment", "## A comparison"), (ComparisonConfig, "## A comparison", None)],
)
def test_the_table_of_keys_is_that_of_the_schema(schema, heading, end):
    part = PAGES[ROOT / "docs" / "config.md"].partition(heading)[2]
    rows = re.findall(r"^\| `([\w.]+)` \| `?([^|`]+)`? \|", part.partition(end)[0] if end else part, re.MULTILINE)
    table = {key: yaml.safe_load(re.sub(r"^1e", "1.0e", default)) for key, default in rows if key not in NETWORK_NAMES}
    known = dict(keys_of(schema))
    assert sorted(known.keys() - table.keys()) == []  # not in the table
    assert sorted(table.keys() - known.keys()) == []  # not in the schema
    assert {k: table[k] for k in known} == {k: shown_default(field) for k, field in known.items()}


NETWORK_NAMES = tuple(NETWORKS)  # of the further table on that page


def test_the_standard_recipe_is_what_the_page_says():
    (shown,) = [block for block in re.findall(r"```yaml\n(.*?)```", PAGES[ROOT / "docs" / "config.md"], re.DOTALL)
                if "network: {name: expansion}" in block]  # fmt: skip
    assert yaml.safe_load(shown) == STANDARD


@pytest.mark.parametrize("part", REGISTRIES)
def test_the_table_names_what_is_registered(part):
    (row,) = re.findall(rf"^\| `{part}\.name` .*$", PAGES[ROOT / "docs" / "config.md"], re.MULTILINE)
    assert "`lyapnet systems`" in row or set(re.findall(r"`(\w+)`", row)) >= {*REGISTRIES[part][0]}


def test_the_weights_that_programs_recommend_are_what_the_page_says():
    page = " ".join(PAGES[ROOT / "docs" / "config.md"].split())
    for name, program in PROGRAMS.items():
        weights = [f"`{key}: {json.dumps(value)}`" for key, value in program.recommended.items()]
        assert f"`{name}` {', '.join(weights[:-1])} and {weights[-1]}" in page


def test_errors_name_sections_that_exist(tmp_path, capsys):
    known = anchors(ROOT / "docs" / "troubleshooting.md")
    kinds = [kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, errors.LyapnetError)]
    named = {kind.section for kind in kinds} - {""}
    assert len(named) >= 4
    assert named <= known
    assert "no-such-section" not in known
    (tmp_path / "broken.ckpt").write_bytes(b"no checkpoint")
    assert main(["evaluate", str(tmp_path / "broken.ckpt")])
    assert "docs/troubleshooting.md#a-checkpoint-is-refused" in capsys.readouterr().err
    assert main(["evaluate", "--no-such-option"])
    assert "troubleshooting" not in capsys.readouterr().err
