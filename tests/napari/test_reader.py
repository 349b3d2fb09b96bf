"""Files, folders and stores as layers."""

import os
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
from napari.utils.notifications import notification_manager
from scipy.io import savemat

from helpers.layers import by_role
from napari_shadowinv import FileFormatError, ProtonSetup, write
from napari_shadowinv._napari.layer_metadata import metadata_of, result_of, setup_of, unit_of
from napari_shadowinv._napari.layers import add_layers, sample_arrows
from napari_shadowinv._napari.reader import get_reader, read_paths
from napari_shadowinv._napari.result_files import follow_arrows, missing_layers
from napari_shadowinv._napari.widgets._layers import cautions_of
from napari_shadowinv.inversion.variables import dataset_from_field

PLUGIN = "napari-shadowinv"


@pytest.fixture
def shot():
    return np.random.default_rng(0).uniform(1, 9, (12, 17))


PRADFORMAT = {
    "object_type": "radiograph", "radiograph_type": "raster", "pradformat_version": "0.2.0",
    "pixel_width": 163.8e-6, "source_object_dist": 1.3e-3, "object_image_dist": 20e-3,
    "spec_name": "p+", "spec_energy": 14.7e6,
}  # fmt: skip


def test_pradformat_opens_with_its_pixels_and_setup(viewer, shot, tmp_path):
    path = tmp_path / "d3he.h5"
    with h5py.File(path, "w") as file:
        file["image"] = shot
        file.attrs.update(PRADFORMAT)
    (layer,) = viewer.open(path, plugin=PLUGIN)
    setup = setup_of(layer)
    assert isinstance(setup, ProtonSetup)
    assert setup.energy == 14.7
    np.testing.assert_allclose(layer.scale, 163.8 / (1 + 20 / 1.3))  # over the magnification
    assert {str(unit) for unit in layer.units} == {"micrometer"}
    assert (layer.name, layer.axis_labels) == ("d3he", ("y", "x"))
    np.testing.assert_array_equal(layer.data, shot)
    assert metadata_of(layer)["file"]["sha256"]
    # Pixels stay pixels where the magnification is unknown.
    with h5py.File(path, "a") as file:
        del file.attrs["source_object_dist"]
    (layer,) = viewer.open(path, plugin=PLUGIN)
    assert setup_of(layer) is None
    assert {str(unit) for unit in layer.units} == {"pixel"}
    assert metadata_of(layer)["file"]["geometry"]["detector_pixel_size"] == 163.8e-6


@pytest.mark.parametrize("suffix", [".mat", ".txt"])
def test_formats_that_napari_does_not_know_need_no_choice(viewer, tmp_path, suffix):
    path, counts = tmp_path / f"shot{suffix}", np.arange(60).reshape(6, 10)
    if suffix == ".mat":
        savemat(path, {"image": counts.astype(np.float64)})
    else:
        np.savetxt(path, counts)
    (layer,) = viewer.open(path, plugin=None)  # raises where several plugins could
    np.testing.assert_array_equal(layer.data, counts)
    assert layer.source.reader_plugin == PLUGIN


def test_what_is_no_shot_is_left_to_others(tmp_path):
    for name in ("empty", "notes.zarr"):
        (tmp_path / name).mkdir()
    for suffix in (".h5", ".nxs"):
        (tmp_path / f"damaged{suffix}").write_bytes(b"no HDF5 at all")
        with h5py.File(tmp_path / f"other{suffix}", "w") as file:
            file["times"] = np.zeros(5)
    names = [path.name for path in tmp_path.iterdir()]
    assert len(names) == 6
    for name in (*names, "film.mov", "paper.pdf"):
        assert get_reader(str(tmp_path / name)) is None, name
    assert get_reader([str(tmp_path / "a.mov")]) is None


@pytest.fixture
def run(tmp_path):
    folder = tmp_path / "run 3"
    folder.mkdir()
    for shot in (1, 2, 10):
        tifffile.imwrite(folder / f"shot{shot}.tif", np.full((6, 8), shot, np.float32))
    (folder / "notes.txt").write_text("a fine day")
    return folder


def test_a_folder_is_a_lazy_stack_in_counting_order(viewer, run, monkeypatch):
    import napari_shadowinv.io

    read, names = napari_shadowinv.io.read_shot, []

    def watched(path, **keywords):
        names.append(path.name)
        return read(path, **keywords)

    monkeypatch.setattr(napari_shadowinv.io, "read_shot", watched)
    ((data, keywords, _),) = read_paths(str(run))
    assert names == ["shot1.tif"]
    layer = viewer.add_image(data, **keywords)  # shows the middle one
    assert set(names) == {"shot1.tif", "shot2.tif"}
    viewer.dims.set_point(0, 2)
    assert names[-1] == "shot10.tif"
    names = [Path(path).name for path in metadata_of(layer)["paths"]]
    assert names == ["shot1.tif", "shot2.tif", "shot10.tif"]
    assert (layer.name, layer.axis_labels) == ("run 3", ("shot", "y", "x"))
    np.testing.assert_array_equal(layer.data[:, 0, 0].compute(), [1, 2, 10])
    # A list is a stack, too.
    ((data, _, _),) = read_paths([str(run / name) for name in names[:2]])
    assert data.shape == (2, 6, 8)


def test_a_stray_file_is_dark_and_gives_a_warning(run):
    (run / "shot0.tif").write_bytes(b"nonsense")  # the first does not end the show
    tifffile.imwrite(run / "shot3.tif", np.ones((5, 5), np.float32))
    complete = (run / "shot1.tif").read_bytes()
    (run / "shot4.tif").write_bytes(complete[:-40])
    ((data, _, _),) = read_paths(str(run))
    assert data.shape == (6, 6, 8)
    for shot, words in (
        (3, r"shot3.tif has 5×5 pixels, but the first.*6×8"),
        (4, r"shot4.tif is truncated"),
    ):
        with pytest.warns(UserWarning, match=f"shown as zeros: .*{words}"):
            assert not data[shot].compute().any()
    for shot in (1, 2, 5):
        assert data[shot].compute().all()


def test_a_result_opens_whole_and_one_of_another_program_with_its_field(
    viewer, solved, proton_setup, tmp_path
):
    write(tmp_path / "shot9.shadowinv", solved, setup=proton_setup)
    layers = viewer.open(tmp_path / "shot9.shadowinv", plugin=None)
    assert all(layer.name.endswith(" – shot9") for layer in layers)
    assert setup_of(layers[0]) == proton_setup
    assert result_of(layers[0]).content.options == solved.options
    missing = add_layers(viewer, missing_layers(viewer, layers[0]))
    np.testing.assert_array_equal(by_role(missing)["reprojection"].data, solved.reprojection)
    dataset = dataset_from_field(solved.displacement, solved.potential, proton_setup)
    write(tmp_path / "field.shadowinv", dataset)
    layers = by_role(viewer.open(tmp_path / "field.shadowinv", plugin=PLUGIN))
    assert list(layers) == ["field", "arrows"]
    field = proton_setup.path_integrated_b(solved.displacement)
    np.testing.assert_allclose(layers["field"].data, 1e3 * np.hypot(*field), rtol=1e-9)
    np.testing.assert_allclose(layers["field"].scale, 1.5)


def test_a_bad_file_is_one_notification_in_a_window(viewer, tmp_path, in_loop, messages):
    for name, content, words in (
        ("cut.shadowinv", b"\x89HDF\r\n\x1a\n" + b"\0" * 40, "damaged, incomplete"),
        ("words.txt", b"# x\n1 2\n3 four\n", "words.txt"),
    ):
        messages.clear()
        (tmp_path / name).write_bytes(content)
        assert in_loop(lambda: viewer.open(tmp_path / name, plugin=None)) == []  # noqa: B023
        (text,) = messages
        assert words in text
        assert "\n" not in text


def test_what_cannot_be_read_is_one_sentence(tmp_path, run, store, inversion):
    with h5py.File(tmp_path / "grid.h5", "w") as file:
        file["Bx"] = file["By"] = np.ones((3, 4, 5))
    (tmp_path / "night").mkdir()
    (tmp_path / "night" / "a.tif").write_bytes(b"nonsense")
    with h5py.File(write(tmp_path / "shot.shadowinv", inversion), "r+") as file:
        file.attrs["report"] = '{"converged": '
    for file in run.iterdir():  # after the question for a reader
        file.unlink()
    shutil.rmtree(store / "displacement")
    (store / "zarr.json").unlink()
    for name in ("pipe.h5", "pipe.tif", "pipe.shadowinv"):  # a pipe would block
        os.mkfifo(tmp_path / name)
    for name, words in (
        ("grid.h5", "trace particles through them with shadowinv forwa"),
        ("night", "none of 1 files can be read as a shot: .*a.tif"),
        ("shot.shadowinv", r"shot\.shadowinv: the result is damaged"),
        (run.name, "contains no image: expected a folder"),
        (store.name, r"could not be read|not a store"),
        ("gone.shadowinv.zarr", "does not exist"),
        ("pipe.h5", "is a pipe"),
        ("pipe.tif", "is a pipe"),
        ("pipe.shadowinv", "is a pipe"),
    ):
        with pytest.raises(FileFormatError, match=words) as error:
            read_paths(str(tmp_path / name))
        assert "\n" not in str(error.value)


@pytest.fixture
def store(solved, proton_setup, tmp_path):
    """Three shots, the first still empty, as a run writes them."""
    import xarray as xr

    result = solved.in_units(proton_setup).to_dataset()
    half = result.copy()
    empty = result.copy(deep=True)
    for name in ("potential", "displacement", "reprojection", "residual"):
        half[name] = 0.5 * result[name]
        empty[name] = np.nan * result[name]
    run = xr.concat(
        [part.drop_dims("site") for part in (empty, half, result)], "shot", data_vars="all"
    )
    run.attrs = result.attrs
    path = tmp_path / "night.shadowinv.zarr"
    run.chunk({"shot": 1}).to_zarr(path, consolidated=False)
    return path


def test_a_store_opens_as_lazy_layers(viewer, store, solved, proton_setup):
    layers = by_role(viewer.open(store, plugin=PLUGIN))
    assert set(layers) == {"residual", "field", "caustic", "arrows"}
    layers |= by_role(add_layers(viewer, missing_layers(viewer, layers["field"])))
    more = {"image", "reprojection", "potential", "field y", "field x"}
    assert set(layers) == {"residual", "field", "caustic", "arrows"} | more
    arrows = layers.pop("arrows")
    assert arrows.visible
    np.testing.assert_allclose(arrows.scale, layers["field"].scale)
    for layer in layers.values():
        assert type(layer.data).__module__.startswith("dask")
        assert layer.data.shape[0] == 3
        assert layer.axis_labels == ("shot", "y", "x")
        np.testing.assert_allclose(layer.scale, [1, 1.5, 1.5])
        assert layer.name.endswith(" – night")
        assert setup_of(layer) == proton_setup
    field = proton_setup.path_integrated_b(solved.displacement)
    np.testing.assert_allclose(layers["field"].data[1].compute(), 500 * np.hypot(*field))
    np.testing.assert_allclose(layers["field"].data[2].compute(), 1e3 * np.hypot(*field))
    np.testing.assert_allclose(layers["field y"].data[2].compute(), 1e3 * field[0])
    np.testing.assert_allclose(layers["field x"].data[2].compute(), 1e3 * field[1])
    metres = {"m": 1.0, "mm": 1e3, "µm": 1e6, "nm": 1e9}[unit_of(layers["potential"])]
    potential = metres * proton_setup.potential(solved.potential)
    np.testing.assert_allclose(layers["potential"].data[2].compute(), potential)
    assert [name for name, layer in layers.items() if layer.visible] == ["field"]
    # The contrast suits the strongest shot, and in the residual most pixels.
    assert layers["field"].contrast_limits[1] == pytest.approx(1e3 * np.hypot(*field).max())
    low, high = layers["residual"].contrast_limits
    assert low == -high
    assert np.median(np.abs(solved.residual)) < high < np.abs(solved.residual).max()


def rays(solved, factor=1.0):
    """Start and displacement of the arrows of a shot of the store."""
    return sample_arrows(factor * solved.displacement)[0]


def test_arrows_follow_the_shot_in_view(viewer, store, solved):
    arrows = by_role(viewer.open(store, plugin=PLUGIN))["arrows"]
    assert (arrows.data[:, 0, 0] == 2).all()  # the strongest
    follow_arrows(viewer)
    length = arrows.length
    for shot, expected in ((1, rays(solved, 0.5)), (2, rays(solved))):
        viewer.dims.set_point(0, shot)
        np.testing.assert_allclose(arrows.data[:, 0, 0], shot)
        np.testing.assert_allclose(arrows.data[:, 1, 0], 0)
        np.testing.assert_allclose(arrows.data[:, :, 1:], expected)
        np.testing.assert_allclose(
            arrows.features["displacement"], np.hypot(*expected[:, 1].T), rtol=1e-6
        )
        assert arrows._view_data.shape == expected.shape
    viewer.dims.set_point(0, 0)
    assert len(arrows.data) == 0
    assert arrows.length == length

    # Nothing is read for arrows that nobody sees.
    arrows.visible = False
    viewer.dims.set_point(0, 2)
    assert len(arrows.data) == 0
    arrows.visible = True
    np.testing.assert_allclose(arrows.data[:, :, 1:], rays(solved))
    viewer.layers.remove(arrows)
    viewer.dims.set_point(0, 1)
    assert (arrows.data[:, 0, 0] == 2).all()


def test_arrows_of_a_store_follow_in_a_window(make_napari_viewer, store, solved, qtbot):
    window = make_napari_viewer()
    layers = by_role(window.open(store, plugin=PLUGIN))
    qtbot.waitUntil(lambda: window.layers.selection.active is layers["field"])
    window.dims.set_point(0, 1)
    np.testing.assert_allclose(layers["arrows"].data[:, :, 1:], rays(solved, 0.5))


def test_a_scan_of_film_is_told_and_so_is_its_result(viewer, tmp_path):
    film = np.full((24, 32), 60_000, np.uint16)
    film[6:-6, 8:-8] = 20_000
    tifffile.imwrite(tmp_path / "film.tif", film)
    tifffile.imwrite(tmp_path / "film2.tif", film)
    ((_, keywords, _),) = read_paths([str(tmp_path / "film.tif"), str(tmp_path / "film2.tif")])
    (record_of_film,) = [
        record for record in notification_manager.records if "film.tif" in record.message
    ]
    (warning,) = metadata_of(keywords)["cautions"]
    assert "wrong sign" in warning.text
    assert warning.text in record_of_film.message
    (read_by_napari,) = viewer.open(tmp_path / "film.tif", plugin="napari")
    assert cautions_of(read_by_napari) == (warning,)
    assert cautions_of(viewer.add_image(film)) == ()


def test_images_of_an_hdf5_file_are_layers(viewer, tmp_path):
    path = tmp_path / "run 1.nxs"
    frames = np.arange(60.0).reshape(3, 4, 5)
    with h5py.File(path, "w") as file:
        file["entry/data"], file["entry/beam"] = frames, frames[0] + 1
    layers = {layer.name: layer.data for layer in viewer.open(path, plugin=PLUGIN)}
    np.testing.assert_array_equal(layers["entry/beam"], frames[0] + 1)
    np.testing.assert_array_equal(layers["entry/data"], frames)
    with h5py.File(path, "a") as file:
        file["entry/pixel_mask"] = np.zeros((4, 5), np.uint32)
        file.attrs["default"], file["entry"].attrs["signal"] = "entry", "data"
    (layer,) = viewer.open(path, plugin=PLUGIN)
    assert (layer.name, layer.data.shape) == ("run 1", (3, 4, 5))


def test_images_that_are_not_opened_are_counted(tmp_path):
    path = tmp_path / "many.h5"
    with h5py.File(path, "w") as file:
        for number in range(10):
            file[f"frame_{number}"] = np.full((4, 5), number)
    assert len(read_paths(str(path))) == 8
    (text,) = [
        record.message for record in notification_manager.records if path.name in record.message
    ]
    assert "8 of 10 images are open" in text
    assert "many.h5::frame_8" in text
