"""The rules of the book itself."""

import re
from pathlib import Path

import jupytext
import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
PAGES = sorted((ROOT / "book").glob("*.md")) + sorted((ROOT / "notebooks").glob("*.md"))
each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)


def code_cells(path):
    return [c for c in jupytext.read(path).cells if c.cell_type == "code"]


def test_there_are_notebooks_and_each_has_its_pair():
    assert NOTEBOOKS
    assert {p.stem for p in NOTEBOOKS} == {p.stem for p in (ROOT / "notebooks").glob("*.md")}


@each_notebook
def test_pair_in_sync_and_no_outputs(path):
    ipynb, md = jupytext.read(path), jupytext.read(path.with_suffix(".md"))
    shared = ("tags", "mystnb")
    parts = [
        [(c.cell_type, c.source, {k: c.metadata[k] for k in shared if k in c.metadata}) for c in nb.cells]
        for nb in (ipynb, md)
    ]
    assert parts[0] == parts[1], f"run: jupytext --sync {path.relative_to(ROOT)}"
    assert not any(c.get("outputs") or c.get("execution_count") for c in ipynb.cells), "commit no outputs"


@each_notebook
def test_cells_are_short(path):
    cells = code_cells(path)
    lesson = re.sub(r"\{solution-start\}.*?\{solution-end\}", "", path.with_suffix(".md").read_text(), flags=re.S)
    lengths = sorted(len(c.source.splitlines()) for c in cells if "hide-input" not in c.metadata.get("tags", []))
    assert lengths[len(lengths) // 2] <= 8 and lengths[-1] <= 30
    assert 12 <= lesson.count("```{code-cell}") <= 22  # besides those in solutions


@each_notebook
def test_nothing_is_said_or_checked_in_a_folded_cell(path):
    # A reader sees only the picture that it makes. What is printed or asserted belongs where it can be read.
    for cell in code_cells(path):
        if any(tag.startswith(("hide-", "remove-")) for tag in cell.metadata.get("tags", [])):
            assert not re.search(r"\bprint\(|\bassert\b|\.assert_|\bassert_close\(", cell.source), cell.source


@each_notebook
def test_every_figure_has_alt_text_a_caption_and_a_name(path):
    draws = re.compile(r"plt\.show\(\)|\bshow3d\(|\.show\(\)")
    for cell in code_cells(path):
        if draws.search(cell.source):
            meta = cell.metadata.get("mystnb", {})
            assert len(meta.get("image", {}).get("alt", "")) > 30, cell.source
            assert len(meta.get("figure", {}).get("caption", "")) > 30, cell.source
            assert meta["figure"].get("name", "").startswith("fig-"), cell.source


@each_notebook
def test_asserts_are_there_and_nothing_reaches_for_the_network(path):
    code = "\n".join(c.source for c in code_cells(path))
    assert code.count("assert") >= 3
    assert not re.search(r"https?://|urlopen|requests\.|urllib|pip install|wget|curl ", code)


@each_notebook
def test_anatomy(path):
    text = path.with_suffix(".md").read_text()
    for part in ("Overview", "{exercise}", "## Summary", "## Compare with the package"):
        assert part in text, part
    assert text.count("{exercise}") == text.count("{solution}") + text.count("{solution-start}") >= 2
    prose = re.sub(r"```\{code-cell\}.*?```", "", text, flags=re.S)
    assert 900 <= len(prose.split()) <= 2300


@pytest.mark.parametrize("path", PAGES, ids=lambda p: p.stem)
def test_images_have_alt_text_and_words_are_plain(path):
    text = path.read_text()
    for image in re.findall(r"```\{(?:image|figure)\}.*?```", text, flags=re.S):
        assert ":alt:" in image
    assert not re.search(r"!\[\]\(", text)
    banned = re.findall(r"\b(?:clearly|simply|obviously|trivially|of course)\b", text, flags=re.I)
    assert not banned, banned


def test_every_page_is_in_the_table_of_contents():
    toc = yaml.safe_load((ROOT / "book/_toc.yml").read_text())
    listed = {toc["root"], *(c["file"] for part in toc["parts"] for c in part["chapters"])}
    assert listed == {str(p.relative_to(ROOT).with_suffix("")) for p in PAGES}


def test_every_version_is_pinned_once_and_only_in_requirements():
    lines = (ROOT / "requirements.txt").read_text().splitlines()
    pins = [line.split("#")[0].strip() for line in lines if line and not line.startswith(("#", "-e"))]
    assert all(re.fullmatch(r"[\w.-]+==[\w.]+", pin) for pin in pins)
    assert "==" not in (ROOT / "pyproject.toml").read_text()
