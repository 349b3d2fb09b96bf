"""The paper: its numbers are those of the benchmarks, its references those of the documentation."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
_, HEAD, BODY = (ROOT / "paper" / "paper.md").read_text("utf-8").split("---\n", 2)
REFERENCES = (ROOT / "paper" / "paper.bib").read_text("utf-8")

# Words of the paper, and the line of a page that holds their numbers as a script printed them.
CLAIMS = [
    ("misses 20.4 % of the peak", "performance", "| toroid 97 | -0.08 / 0.17 | -20.4 / 42.7 |"),
    (
        "2–3 h on 32 cores for an image of 200 × 200 px",
        "paper",
        "| one image of 200 × 200 px | 2–3 h on 32 cores | 0.4–0.8 s on 2 cores |",
    ),
    (
        "an image of 200 × 200 px takes 0.4–0.8 s on 2 cores",
        "paper",
        "| one image of 200 × 200 px | 2–3 h on 32 cores | 0.4–0.8 s on 2 cores |",
    ),
    (
        "pysdot takes 23 times as long",
        "performance",
        "| toroid 97: solve by pysdot (23 times ours) |",
    ),
    (
        "OTT needs 49 s for an error of 1.7 %",
        "performance",
        "(Sinkhorn, ε = 30, 10 and 3 px²): 49 s for 1.7 % on the toroid of 97.",
    ),
    ("$n^{1.02}$", "performance", "solve n^1.02 (toroid 97)"),
    (
        "a burner frame of 1152×928 px 0.9 s",
        "performance",
        "A burner frame of 1152×928 px takes 0.9 s by default",
    ),
    (
        "With 10 % noise, the error of the peak stays below 10 % up to 308 MG µm, "
        "where the publication states 300",
        "paper",
        "| peak error below 10 % up to, MG µm, 10 % noise | 300 | 308 |",
    ),
    (
        "for a linear inversion the limit is 35",
        "paper",
        "| Poisson's error below 10 % up to, MG µm | 30 | 35 |",
    ),
    (
        "Of a toroid of 97 MG µm without noise, the retrieved field is wrong by 0.17 %, "
        "where the linear one is wrong by 42.7 %",
        "performance",
        "| toroid 97 | -0.08 / 0.17 | -20.4 / 42.7 |",
    ),
    (
        "At 290 MG µm rays cross. Transport is then wrong by 16.90 %; "
        "a fit of images at three energies by 0.34 %",
        "paper",
        "| 290 | -6.99 / 16.90 | +0.22 / 0.56 | 1.01 | one image cannot tell | +0.34 / 0.34 |",
    ),
    ("Two folded radiographs at 14.7 and 30 MeV", "fit", "Two radiographs of one object, at 14.7"),
]
NUMBER = re.compile(r"\d+(?:\.\d+)?")


def one_line(text: str) -> str:
    return " ".join(text.split())


@pytest.mark.parametrize(("words", "page", "line"), CLAIMS)
def test_a_number_is_that_of_the_documentation(words: str, page: str, line: str) -> None:
    assert words in one_line(BODY)
    text = (DOCS / f"{page}.md").read_text("utf-8")
    assert line in text
    printed = next(full for full in text.splitlines() if line in full)
    assert set(NUMBER.findall(words)) <= set(NUMBER.findall(printed))


def test_no_other_number_stands_in_the_paper() -> None:
    text = one_line(BODY)
    for words, _, _ in CLAIMS:
        text = text.replace(words, "")
    text = re.sub(r"\[?-?@\w+|\]\(\S+\)|\[doi:\S+", "", text)  # citations, links, pictures
    assert NUMBER.findall(text) == []


def test_it_has_the_sections_and_the_length_that_the_journal_asks_for() -> None:
    assert re.findall(r"^# (.*)$", BODY, re.MULTILINE) == [
        "Summary",
        "Statement of need",
        "State of the field",
        "Software design",
        "Research impact statement",
        "AI usage disclosure",
        "Acknowledgements",
        "References",
    ]
    assert 750 <= len(BODY.split()) <= 1750
    head = yaml.safe_load(HEAD)
    assert {"title", "tags", "authors", "affiliations", "date", "bibliography"} == set(head)


def test_every_figure_is_made_by_the_script_that_its_caption_names() -> None:
    figures = re.findall(r"!\[.*\(made by `(docs/\w+\.py)`\)\.\]\(\.\./docs/(.*?)\)", BODY)
    assert len(figures) == BODY.count("![")
    for script, name in figures:
        assert (DOCS / name).is_file()
        assert f'"{name}"' in (ROOT / script).read_text("utf-8")


def test_every_reference_is_cited_and_known_to_the_documentation() -> None:
    keys = re.findall(r"^@\w+\{(\w+),", REFERENCES, re.MULTILINE)
    assert set(re.findall(r"@(\w+)", BODY)) == set(keys)
    pages = [ROOT / "README.md", *DOCS.glob("*.md")]
    documentation = "\n".join(page.read_text("utf-8") for page in pages)
    for entry in REFERENCES.split("\n@"):
        identifier = re.search(r"(?:eprint|pages|url) = \{(?:https://)?(.*?)\}", entry)
        assert identifier is not None, entry
        assert identifier[1] in documentation
