"""The script that compares the numbers in the pages with what the program prints."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture
def script(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(ROOT / "docs")
    monkeypatch.chdir(tmp_path)
    return importlib.import_module("check_numbers")


PAGE = """A page.

```python
print("field 9.71 ± 0.3 mT m")  # field 9.7 ± 0.3 mT m
print("it took 3.2 s, solver 4e-06 %, shot 12 of 3,400")
print("errors: 45 % by the beam, 1.3 % by noise")
```

```text
it took 4.5 s, solver 7e-06 %, shot 12 of 3,400
errors: 47 % by the beam, 1.3 % by noise
…
peak 3 px
```
"""


def test_a_number_that_differs_is_named_with_its_line(script: ModuleType, tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(PAGE, encoding="utf-8")
    result = script.check_page(page)
    assert result.compared == 4
    assert result.disagreements == [
        "page.md:11: shows 47, printed 45",
        "page.md:13: is not printed: peak 3 px",
    ]


def test_input_of_a_page_is_written_and_not_compared(script: ModuleType, tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    table = "file, energy\nshot.tif, 14.7\nshot.tif, 3"
    page.write_text(f"The table `shots.csv`:\n\n```text\n{table}\n```\n", encoding="utf-8")
    result = script.check_page(page)
    assert (result.compared, result.disagreements) == (0, [])
    assert result.left_out == ["not compared: page.md:5: little of it is printed"]
    assert Path("shots.csv").read_text("utf-8").strip() == table


def test_a_number_of_a_sentence_that_is_not_printed_is_listed(
    script: ModuleType, tmp_path: Path
) -> None:
    page = tmp_path / "page.md"
    page.write_text(PAGE + "\nThe beam is 45 % off, the peak 8 %.\n", encoding="utf-8")
    (line,) = script.unprinted_numbers(script.check_page(page))
    assert line.startswith("page.md:16: 8: ")
