"""Files for Git hosts and other machines, as far as they can be tried here: versions and commands are ours."""

import subprocess
import sys
import tomllib

import pytest
import yaml

from tests.gate import PARTS
from tests.pages import README, ROOT, blocks

WORKFLOWS = {path.stem: yaml.safe_load(path.read_text("utf-8")) for path in ROOT.glob(".github/workflows/*.yml")}
TEMPLATES = sorted(ROOT.glob(".github/ISSUE_TEMPLATE/*.yml"))
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
ALL = ".ci/run ${{ matrix.part }}"
VERSION = "Programming Language :: Python :: 3."


def declared() -> list[str]:
    return [line.rpartition(" ")[2] for line in PROJECT["classifiers"] if line.startswith(VERSION)]


def commands(job: dict) -> set[str]:
    return {step["run"] for step in job["steps"] if "run" in step}


def documented() -> set[str]:
    """The commands of the README's blocks, each by itself, and those of .ci."""
    lines = [block.replace("\\\n", " ") for block in blocks("bash", README)]
    return {part.strip() for line in lines for part in line.replace("\n", "&&").split("&&")} | {ALL}


def test_the_matrix_has_the_versions_of_the_project():
    matrix = WORKFLOWS["tests"]["jobs"]["default"]["strategy"]["matrix"]
    assert matrix["python"] == declared()
    assert PROJECT["requires-python"] == f">={declared()[0]}"
    assert len(matrix["os"]) == 3


def test_the_commands_are_those_of_the_readme():
    for job in WORKFLOWS["tests"]["jobs"].values():
        assert commands(job) <= documented()
    assert not commands({"steps": [{"run": "pytest -n 3"}]}) <= documented()


def test_all_parts_of_the_gate_are_run():
    job = WORKFLOWS["tests"]["jobs"]["all"]
    assert ALL in commands(job)
    assert job["strategy"]["matrix"]["part"] == [f"{k}/{PARTS}" for k in range(1, PARTS + 1)]


def test_the_site_is_built_as_the_pages_say():
    (built,) = [c for c in commands(WORKFLOWS["site"]["jobs"]["publish"]) if c.startswith("sphinx-build")]
    assert built.startswith("sphinx-build -q -W ")
    assert built.endswith(" docs build/site")
    assert " -D nb_execution_mode=force " in built, "the notebooks show what they printed"


@pytest.mark.parametrize("template", TEMPLATES, ids=lambda path: path.stem)
def test_a_template_has_what_its_host_asks_for(template):
    form = yaml.safe_load(template.read_text("utf-8"))
    assert form["name"]
    assert form["description"]
    ids = [field["id"] for field in form["body"]]
    assert len(ids) == len(set(ids))
    assert all(field["attributes"]["label"] for field in form["body"])


def git(*arguments: str, folder) -> str:
    command = ["git", "-c", "user.name=a", "-c", "user.email=a@localhost", *arguments]
    return subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True).stdout


@pytest.mark.skipif(sys.platform == "win32", reason="a shell script of the Linux workflow")
def test_each_version_of_the_site_keeps_its_folder(tmp_path):
    origin, clone, site = tmp_path / "origin", tmp_path / "clone", tmp_path / "site"
    git("init", "--bare", "-q", str(origin), folder=tmp_path)
    git("clone", "-q", str(origin), str(clone), folder=tmp_path)
    git("commit", "-q", "--allow-empty", "-m", "first", folder=clone)
    site.mkdir()
    for version in ("v1", "main", "main"):
        (site / "index.html").write_text(version)
        subprocess.run([ROOT / ".ci" / "publish", site, version], cwd=clone, check=True, capture_output=True)
    files = git("ls-tree", "-r", "--name-only", "gh-pages", folder=origin).split()
    assert files == [".nojekyll", "index.html", "main/index.html", "v1/index.html"]
    assert git("show", "gh-pages:v1/index.html", folder=origin) == "v1"
