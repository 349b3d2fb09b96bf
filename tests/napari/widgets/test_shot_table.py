"""The table of shots in *Invert*."""

from __future__ import annotations

import numpy as np
import pytest

from napari_shadowinv._napari.layer_metadata import role_of
from napari_shadowinv.inversion.variables import setup_from_dataset
from napari_shadowinv.io import read
from napari_shadowinv.io.store import DONE, StackStore
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import toroid
from napari_shadowinv.physics.setup import ProtonSetup

SHAPE = (48, 48)
SETUP = ProtonSetup(
    energy=14.7, source_object_distance=0.01, object_image_distance=0.3, pixel_size=1e-5
)
ENERGIES = (6.0, 14.7, 30.0)


def at(energy):
    return SETUP.model_copy(update={"energy": energy})


@pytest.fixture
def pack(tmp_path):
    """One toroid on three films, and a table that leaves the last one out."""
    for number, energy in enumerate(ENERGIES):
        displacement = toroid(SHAPE, at(energy), 25.0, 80e-6).displacement
        np.save(tmp_path / f"film{number}.npy", synthetic_image(displacement))
    rows = ["file,energy,brightness,exclude", "film0.npy,6,1.5,", "film1.npy,,,", "film2.npy,,,yes"]
    (tmp_path / "pack.csv").write_text("\n".join(rows))
    return tmp_path / "pack.csv"


@pytest.fixture
def tool(window, open_widget, pack):
    tool = open_widget("Invert")
    tool.options.restore({"tolerance": 1e-3})
    tool.store.run.restore({"workers": 1})
    tool.store.folder.restore({"path": str(pack.with_name("run.shadowinv.zarr"))})
    tool.image.set_kind("table")
    tool.image.form.restore({"path": str(pack)})
    tool.setup.show_setup(SETUP.model_dump())
    return tool


def run(tool, qtbot):
    tool.panel.button.click()
    qtbot.waitUntil(
        lambda: not (tool.panel.running or tool.stack_view.busy),
        timeout=60_000,
    )
    return StackStore(tool.store.path)


def test_a_table_is_inverted(window, tool, qtbot, messages):
    store = run(tool, qtbot)
    assert messages == []
    assert store.names == ("film0.npy", "film1.npy")
    assert (store.statuses() == DONE).all()
    stack = read(tool.store.path)
    assert [setup_from_dataset(stack.isel(shot=k)) for k in range(2)] == [at(6.0), SETUP]
    (origin,) = store.report(0)["provenance"]["images"]
    assert origin["brightness"] == 1.5
    # The layer is in the units of each shot's own energy: the same field twice.
    (field,) = [layer for layer in window.layers if role_of(layer) == "field"]
    first, second = (np.asarray(field.data[k]) for k in range(2))
    assert first.max() == pytest.approx(second.max(), rel=0.02)
    reach = np.hypot(*stack["displacement"].values.swapaxes(0, 1)).max(axis=(1, 2))
    assert reach[0] > 1.3 * reach[1]
    in_si = np.hypot(*stack["path_integrated_b"].values[1])
    np.testing.assert_allclose(second / second.max(), in_si / in_si.max(), atol=1e-6)


def test_mistakes_are_told(tool, qtbot, messages, pack):
    def expect(words):
        before = len(messages)
        tool.panel.button.click()
        qtbot.waitUntil(lambda: not tool.panel.running, timeout=60_000)
        assert words in messages[before]

    pack.write_text("file,energy\nfilm0.npy,9\n")
    tool.setup.set_kind("none")
    expect("has an energy of 9 MeV and no setup")
    tool.image.form.restore({"path": ""})
    expect("o table is selected")
    tool.image.form.restore({"path": "/no/pack.csv"})
    expect("/no/pack.csv does not exist: expected a .csv file")
    tool.image.form.restore({"path": str(pack.with_name("film0.npy"))})
    expect("film0.npy is no table: expected a .csv file")
    tool.image.form.restore({"path": str(pack.parent)})
    expect(f"{pack.parent} is no table: expected a .csv file")
    assert not tool.store.path.exists()
