"""Cautions are values: their codes are documented, and survive files of later versions."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path

import pytest

from napari_shadowinv import cautions
from napari_shadowinv.cautions import CAUTION_CODES, Caution

ROOT = Path(__file__).parents[1]
CODE = re.compile(r"Caution\(\s*\"([a-z-]+)\"")


def test_trust_page_lists_every_code():
    page = (ROOT / "docs" / "trust.md").read_text(encoding="utf-8")
    listed = set(re.findall(r"`([a-z-]+)`", page))
    assert set(CAUTION_CODES) - {"other"} <= listed


def test_every_code_is_used_by_the_package():
    paths = set((ROOT / "src").rglob("*.py")) - {Path(cautions.__file__)}
    source = "".join(path.read_text(encoding="utf-8") for path in paths)
    assert set(CAUTION_CODES) - {"other"} <= set(re.findall(r"\"([a-z-]+)\"", source))
    assert set(CODE.findall(source)) <= set(CAUTION_CODES)


def test_a_code_that_is_not_listed_is_refused():
    with pytest.raises(ValueError, match="got the caution code 'typo'"):
        Caution("typo", "a sentence")


def test_json_restores_a_caution_also_of_a_later_version():
    caution = Caution("flux", "the flux differs")
    written = json.loads(json.dumps(dataclasses.asdict(caution)))
    assert Caution.from_json(written) == caution
    assert Caution.from_json(caution) is caution
    later = {"code": "of-a-later-version", "text": "a sentence"}
    assert Caution.from_json(later) == Caution("other", "a sentence")
    assert caution.about("a.tif") == Caution("flux", "a.tif: the flux differs")
