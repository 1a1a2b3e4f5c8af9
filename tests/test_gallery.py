"""The gallery links the config of every task of conf/, and has a small picture of each but the variants."""

import re

from tests.pages import PAGES, ROOT

TASKS = {path.stem for path in ROOT.glob("conf/*.yaml") if not path.name.startswith("compare")}
SECTIONS, _, VARIANTS = PAGES[ROOT / "docs" / "gallery.md"].partition("## Variants")


def linked(text: str) -> list[str]:
    """The tasks whose config a text links, each by the name of its file."""
    found = re.findall(r"\[([^]]*)\]\(\.\./conf/(\w+)\.yaml\)", text)
    assert all(shown == name for shown, name in found)
    return [name for _, name in found]


def test_every_task_is_in_the_gallery_once():
    assert sorted(linked(SECTIONS) + linked(VARIANTS)) == sorted(TASKS)


def test_every_section_has_a_config_and_its_small_picture():
    for section in SECTIONS.split("\n## ")[1:]:
        (task,) = linked(section)
        assert re.findall(r"!\[.*?\]\(gallery/(\w+)\.png\)", section) == [task]
    pictures = {path.stem: path.stat().st_size for path in ROOT.glob("docs/gallery/*.png")}
    assert pictures.keys() == {*linked(SECTIONS)}
    assert max(pictures.values()) < 60_000
