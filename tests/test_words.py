"""The language of the code: names are nouns of the field, sentences those of an experimenter.

Read from the source with `ast`, so that comments and code of other people do not count.
"""

from __future__ import annotations

import ast
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from pydantic import BaseModel

from helpers.pages import PAGES, ROOT, WRITTEN_PAGES
from helpers.sources import tree_of, trees_of
from napari_shadowinv.film.pack import Pack
from napari_shadowinv.options import FitChoices, FitOptions, InversionOptions
from napari_shadowinv.physics.setup import SETUPS
from napari_shadowinv.preprocessing import Recipe

SOURCES = sorted((ROOT / "src").rglob("*.py"))
FACES = {"cli", "_napari"}
FILES = [*SOURCES, *sorted((ROOT / "tests").rglob("*.py"))]

VAGUE_WORDS = """
one own other others found known told given kept made left whole rest asked held seen here there
these those such same planned named shown placed drawn wanted meant
"""
VAGUE_NAMES = frozenset(VAGUE_WORDS.split())
MAX_VAGUE_SHARE = 0.005
# In 1,000 words of docstrings: nouns say more than clauses and pronouns.
MAX_RATES = {r"\bwhat\b": 1.0, r"\b(?:that|those) of\b": 0.5}
# Idioms that no experimenter writes, and what to write instead.
IDIOMS = {
    r"(?<!cannot )\b(?:tells?|told|telling)\b": "report, show, say, depend on, contain",
    r"\bso many\b": "the number",
    r"\bas given\b": "by name what was entered",
    r"\bE beside B\b": "E and B together",
}


def assigned_names(node: ast.AST) -> Iterator[str]:
    """The variables that a statement or comprehension assigns."""
    targets: list[ast.expr] = []
    if isinstance(node, ast.Assign):
        targets = node.targets
    elif isinstance(node, ast.For | ast.comprehension | ast.AnnAssign | ast.NamedExpr):
        targets = [node.target]
    while targets:
        target = targets.pop()
        if isinstance(target, ast.Name):
            yield target.id
        elif isinstance(target, ast.Tuple | ast.List):
            targets += target.elts
        elif isinstance(target, ast.Starred):
            targets.append(target.value)


DOCUMENTED = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


@pytest.fixture(scope="module")
def docstrings() -> dict[str, str]:
    """Each docstring by the place of its function, class or module."""
    return {
        f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 1)}": text
        for path in SOURCES
        for node in ast.walk(tree_of(path))
        if isinstance(node, DOCUMENTED) and (text := ast.get_docstring(node))
    }


@pytest.fixture(scope="module")
def messages() -> list[tuple[Path, int, str]]:
    """The sentences that people read, not docstrings, keys or patterns, with module and line."""
    texts = []
    for path in SOURCES:
        skipped = {
            id(node.body[0].value)
            for node in ast.walk(tree_of(path))
            if isinstance(node, DOCUMENTED) and node.body and isinstance(node.body[0], ast.Expr)
        }
        texts += [
            (path, node.lineno, node.value)
            for node in ast.walk(tree_of(path))
            if isinstance(node, ast.Constant) and isinstance(node.value, str)
            if id(node) not in skipped and " " in node.value
        ]
    return texts


def test_variables_are_named_by_what_they_hold():
    names = Counter[str]()
    vague = Counter[str]()
    for path, tree in trees_of(FILES).items():
        for node in ast.walk(tree):
            for name in assigned_names(node):
                names[name] += 1
                if name.strip("_") in VAGUE_NAMES:
                    vague[str(path.relative_to(ROOT))] += 1
    share = vague.total() / names.total()
    assert share < MAX_VAGUE_SHARE, f"{share:.2%}, most in {vague.most_common(8)}"


def test_docstrings_begin_with_a_verb_or_a_noun(docstrings):
    wrong = [place for place, text in docstrings.items() if re.match(r"(?:What|Tell)\b", text)]
    assert not wrong


@pytest.mark.parametrize("idiom", IDIOMS)
def test_docstrings_messages_and_pages_use_no_idiom(docstrings, messages, idiom):
    wrong = [place for place, text in docstrings.items() if re.search(idiom, text)]
    wrong += [f"{path.name}:{line}" for path, line, text in messages if re.search(idiom, text)]
    wrong += [
        f"{path.relative_to(ROOT)}:{number}"
        for path in PAGES
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if re.search(idiom, line)
    ]
    assert not wrong, f"write {IDIOMS[idiom]}"


@pytest.mark.parametrize("words", MAX_RATES)
def test_docstrings_name_things_by_nouns(docstrings, words):
    texts = {place: text.lower() for place, text in docstrings.items()}
    counts = Counter({place: len(re.findall(words, text)) for place, text in texts.items()})
    total = sum(len(re.findall(r"[a-z]+", text)) for text in texts.values())
    assert 1000 * counts.total() / total < MAX_RATES[words], counts.most_common(8)


def model_keys() -> set[str]:
    """The keys of options, setups, recipes and packs that are no words of a sentence."""
    models: list[type[BaseModel]] = [InversionOptions, FitOptions, FitChoices, Recipe, Pack]
    models += SETUPS.values()
    return {key for model in models for key in model.model_fields if "_" in key}


def test_messages_below_the_faces_suit_each_of_them(messages):
    """A window has no flags, a command no keywords; words such as a free boundary suit both."""
    keys = "|".join(model_keys() | {"max_shots", "other_folders"})
    options = "|".join([*InversionOptions.model_fields, *FitOptions.model_fields])
    of_one_face = re.compile(rf"--[a-z]{{2}}|\b(?:{keys})\b|\b(?:{options})='")
    assert not [
        f"{path.name}:{line}"
        for path, line, text in messages
        if not FACES & set(path.parts)
        # Each face has a name for a key in braces.
        if of_one_face.search(re.sub(r"\{\w+\}", "", text))
        and not re.fullmatch(r"[\s\w]+", text)  # nor a list of keys
    ]


def prose_lines(text: str) -> Iterator[str]:
    """The lines of a page outside code, tables and headings, without numbers of lists."""
    in_code = False
    for line in text.splitlines():
        if re.match(r"\s*(```|~~~)", line):
            in_code = not in_code
        elif not in_code and not re.match(r"\s*[|#>]| {4}|<", line):
            yield re.sub(r"`[^`]*`", "code", re.sub(r"^\s*\d+\. ", "", line))


@pytest.mark.parametrize("page", WRITTEN_PAGES, ids=lambda page: page.stem)
def test_a_page_has_one_sentence_a_line(page: Path) -> None:
    """So that a change of a sentence changes one line."""
    abbreviations = r"(?<!\b[A-Z])(?<!al)(?<!Eq)(?<!Eqs)(?<!Fig)(?<!e\.g)(?<!i\.e)(?<!r\.m\.s)"
    two_sentences = re.compile(rf"[a-z0-9)\"*]{abbreviations}\.\*{{0,2}} +[A-Z][a-z]")
    lines = prose_lines(page.read_text(encoding="utf-8"))
    assert [line for line in lines if two_sentences.search(re.sub(r"\([^()]*\)", "", line))] == []
