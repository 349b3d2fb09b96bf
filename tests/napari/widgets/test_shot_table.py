"""The table of shots in *Invert*: rows of a file, changed in the window."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from qtpy.QtCore import Qt

from napari_shadowinv._napari.layer_metadata import role_of
from napari_shadowinv.inversion.variables import setup_from_dataset
from napari_shadowinv.io import read
from napari_shadowinv.io.store import DONE, StackStore
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import toroid
from napari_shadowinv.physics.setup import ProtonSetup
from napari_shadowinv.pipeline.shot_table import table_rows

SHAPE = (48, 48)
SETUP = ProtonSetup(
    energy=14.7, source_object_distance=0.01, object_image_distance=0.3, pixel_size=1e-5
)
ENERGIES = (6.0, 14.7, 30.0)
USE, ENERGY, GAIN, MASK = range(4)


def at(energy: float) -> ProtonSetup:
    return SETUP.model_copy(update={"energy": energy})


@pytest.fixture
def pack(tmp_path: Path) -> Path:
    """One toroid on three films, and a table of them that has a wrong energy."""
    for number, energy in enumerate(ENERGIES):
        displacement = toroid(SHAPE, at(energy), 25.0, 80e-6).displacement
        np.save(tmp_path / f"film{number}.npy", synthetic_image(displacement))
    np.save(tmp_path / "mask.npy", np.ones(SHAPE))
    rows = [
        "file,energy,brightness,mask",
        "film0.npy,9,1.5,mask.npy",
        "film1.npy,,,",
        "film2.npy,30,,",
    ]
    (tmp_path / "pack.csv").write_text("\n".join(rows))
    return tmp_path / "pack.csv"


@pytest.fixture
def tool(window: Any, open_widget: Callable[[str], Any], pack: Path) -> Any:
    tool = open_widget("Invert")
    tool.options.restore({"tolerance": 1e-3})
    tool.store.run.restore({"workers": 1})
    tool.store.folder.edit.setText(str(pack.with_name("run.shadowinv.zarr")))
    tool.shots.set_kind("table")
    tool.shots.table.file.edit.setText(str(pack))
    tool.shots.table.file.changed.emit()
    tool.setup.show_setup(SETUP.model_dump())
    return tool


def write(tool: Any, row: int, at: int, text: str) -> None:
    tool.shots.table.table.item(row, at).setText(text)


def use(tool: Any, row: int, *, used: bool) -> None:
    state = Qt.CheckState.Checked if used else Qt.CheckState.Unchecked
    tool.shots.table.table.item(row, USE).setCheckState(state)


def run(tool: Any, qtbot: Any) -> StackStore:
    tool.panel.button.click()
    qtbot.waitUntil(
        lambda: not (tool.panel.running or tool.stack_view.busy),
        timeout=60_000,
    )
    return StackStore(tool.store.path)


def test_a_table_is_shown_changed_and_inverted(
    window: Any, tool: Any, qtbot: Any, pack: Path, messages: list[str]
) -> None:
    cells = tool.shots.table.table
    assert cells.isVisible()
    texts = [[cells.item(row, at).text() for at in range(4)] for row in range(3)]
    assert texts == [
        ["film0.npy", "9", "1.5", "mask.npy"],
        ["film1.npy", "", "", ""],
        ["film2.npy", "30", "", ""],
    ]
    write(tool, 0, ENERGY, "6")
    write(tool, 0, MASK, "")
    use(tool, 2, used=False)
    store = run(tool, qtbot)
    assert messages == []
    assert store.names == ("film0.npy", "film1.npy")
    assert (store.statuses() == DONE).all()
    stack = read(tool.store.path)
    assert [setup_from_dataset(stack.isel(shot=k)) for k in range(2)] == [at(6.0), SETUP]
    (origin,) = store.report(0)["provenance"]["images"]
    assert "mask" not in origin
    assert origin["brightness"] == 1.5
    # The layer is in the units of each shot's own energy: the same field twice.
    (field,) = [layer for layer in window.layers if role_of(layer) == "field"]
    first, second = (np.asarray(field.data[k]) for k in range(2))
    assert first.max() == pytest.approx(second.max(), rel=0.02)
    reach = np.hypot(*stack["displacement"].values.swapaxes(0, 1)).max(axis=(1, 2))
    assert reach[0] > 1.3 * reach[1]
    in_si = np.hypot(*stack["path_integrated_b"].values[1])
    np.testing.assert_allclose(second / second.max(), in_si / in_si.max(), atol=1e-6)
    # The file is as it was.
    assert table_rows(pack)[0].beam == {"energy": 9}


def test_mistakes_are_told(tool: Any, qtbot: Any, messages: list[str]) -> None:
    def expect(words: str) -> None:
        before = len(messages)
        tool.panel.button.click()
        qtbot.waitUntil(lambda: not tool.panel.running, timeout=60_000)
        assert words in messages[before]

    write(tool, 1, ENERGY, "much")
    expect("'film1.npy': received 'much', expected a number")
    write(tool, 1, ENERGY, "")
    write(tool, 1, GAIN, "-1")
    expect("'film1.npy': 'Brightness' is -1.0: it must be greater than 0")
    write(tool, 1, GAIN, "")
    for row in range(3):
        use(tool, row, used=False)
    expect("excludes all of its 3 images")
    use(tool, 0, used=True)
    tool.setup.picker.set_kind("none")
    expect("has an energy of 9 MeV and no setup")
    tool.shots.table.file.edit.setText("")
    expect("o table is selected")
    tool.shots.table.file.edit.setText("/no/pack.csv")
    expect("/no/pack.csv")
    assert not tool.store.path.exists()


def test_the_rows_are_saved_as_they_are_shown(tool: Any, pack: Path, choose: Any) -> None:
    write(tool, 0, ENERGY, "6")
    write(tool, 1, GAIN, "0.8")
    use(tool, 2, used=False)
    folder = pack.with_name("other")
    folder.mkdir()
    choose(folder / "new")
    tool.shots.table.save_button.click()
    rows = table_rows(folder / "new.csv")
    assert [row.beam.get("energy") for row in rows] == [6.0, None, 30.0]
    assert [row.brightness for row in rows] == [1.5, 0.8, None]
    assert [row.exclude for row in rows] == [False, False, True]
    assert [row.file.resolve() for row in rows] == [
        pack.with_name(f"film{k}.npy") for k in range(3)
    ]
    assert rows[0].mask is not None
    assert rows[0].mask.resolve() == pack.with_name("mask.npy")
