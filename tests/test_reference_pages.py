"""The pages of the reference that are written when the site is built."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import pytest

import napari_shadowinv

FILE = Path(__file__).parents[1] / "docs" / "_ext" / "reference_pages.py"


@pytest.fixture(scope="module")
def pages() -> Any:
    pytest.importorskip("sphinx")
    spec = importlib.util.spec_from_file_location("reference_pages", FILE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_each_public_name_has_one_task(pages: Any) -> None:
    names = [name for task in pages.TASKS.values() for name in task]
    assert len(names) == len(set(names))
    assert set(names) == set(napari_shadowinv.__all__) - {"__version__"}


def test_api_page_lists_names_below_their_tasks(pages: Any) -> None:
    text = pages.api_page()
    section = text.split("### Invert many shots\n")[1].split("###")[0]
    assert "run_stack" in section
    assert "add_to_viewer" not in section
