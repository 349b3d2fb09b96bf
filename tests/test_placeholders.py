"""What must be filled in before a release: every placeholder, with the files that hold it."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]

# To fill one in, replace it in its files and remove it here; `make placeholders` lists the lines.
REMAINING = {
    "PLACEHOLDER_REPOSITORY": {  # address of the repository, without https://
        "pyproject.toml",
        "CITATION.cff",
        ".zenodo.json",
        "conda/recipe.yaml",
    },
    "PLACEHOLDER_DOCUMENTATION": {  # address of the site, without https://
        "pyproject.toml",
        "CITATION.cff",
        "conda/recipe.yaml",
    },
    "PLACEHOLDER_CONTACT": {"CODE_OF_CONDUCT.md", "SECURITY.md"},  # e-mail address
    "PLACEHOLDER_MAINTAINER": {"conda/recipe.yaml"},  # account of the recipe's maintainer
    "PLACEHOLDER_SHA256": {"conda/recipe.yaml"},  # of the source distribution, after its release
    "PLACEHOLDER_AUTHOR": {"paper/paper.md"},  # the paper's authors
    "PLACEHOLDER_AFFILIATION": {"paper/paper.md"},
    "PLACEHOLDER_DATE": {"paper/paper.md"},  # of its submission, such as 1 May 2027
    "PLACEHOLDER_IMPACT": {"paper/paper.md"},  # who uses the package, and publications
    "PLACEHOLDER_AI_DISCLOSURE": {"paper/paper.md"},  # the journal asks the authors for it
    "PLACEHOLDER_FUNDING": {"paper/paper.md"},
}
FOLDERS = (".", ".github", "benchmarks", "conda", "containers", "docs", "examples", "paper", "src")
TEXTS = {"", ".cff", ".def", ".json", ".md", ".py", ".toml", ".yaml", ".yml"}


def texts() -> dict[str, str]:
    """The text files of the repository by their paths, without tests and built files."""
    paths = [
        path
        for folder in FOLDERS
        for path in (ROOT / folder).glob("*" if folder == "." else "**/*")
        if path.is_file() and path.suffix in TEXTS and path.name not in ("Makefile", ".coverage")
    ]
    return {path.relative_to(ROOT).as_posix(): path.read_text("utf-8") for path in paths}


def test_the_remaining_placeholders_are_these() -> None:
    places: dict[str, set[str]] = {}
    for path, text in texts().items():
        for name in re.findall(r"PLACEHOLDER_[A-Z0-9_]+", text):
            places.setdefault(name, set()).add(path)
    assert places == REMAINING


def test_a_release_is_refused_while_a_placeholder_would_be_published() -> None:
    workflow = (ROOT / ".github" / "workflows" / "release.yml").read_text("utf-8")
    (refused,) = re.findall(r"! git grep -n PLACEHOLDER_ -- (.*)", workflow)
    later = {"conda/recipe.yaml", "paper/paper.md"}
    assert set(refused.split()) == set().union(*REMAINING.values()) - later
