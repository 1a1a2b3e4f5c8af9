"""The gallery has every task of conf/, as the file has it, with a picture of its own that is small."""

import re

import yaml

from tests.pages import PAGES, ROOT, blocks

GALLERY = ROOT / "docs" / "gallery.md"
TASKS = {path.name: path for path in ROOT.glob("conf/*.yaml") if not path.name.startswith("compare")}


def shown() -> dict[str, str]:
    """The block of each config that is shown, by the name of its file."""
    return {block.partition("\n")[0].removeprefix("# conf/"): block for block in blocks("yaml", GALLERY)}


def test_every_task_is_in_the_gallery():
    variants = set(re.findall(r"\]\(\.\./conf/([\w.]+)\)", PAGES[GALLERY]))
    assert shown().keys() | variants == TASKS.keys()
    assert not shown().keys() & variants


def test_configs_are_shown_as_they_are():
    blocks_of, files = shown(), {name: yaml.safe_load(TASKS[name].read_text(encoding="utf-8")) for name in shown()}
    assert {name: yaml.safe_load(block) for name, block in blocks_of.items()} == files
    assert yaml.safe_load(blocks_of["reacher.yaml"].replace("170", "171")) != files["reacher.yaml"]


def test_every_task_that_is_shown_has_a_small_picture():
    pictures = {path.name: path.stat().st_size for path in ROOT.glob("docs/gallery/*.png")}
    assert pictures.keys() == {name.replace(".yaml", ".png") for name in shown()}
    assert max(pictures.values()) < 60_000
