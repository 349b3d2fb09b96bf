"""Sample data: available at once, with setup and source, and with the intended content."""

from pathlib import Path

import numpy as np
import pytest

from helpers.layers import by_role
from napari_shadowinv import OpticalSetup, ProtonSetup, read
from napari_shadowinv._napari import samples
from napari_shadowinv._napari.layer_metadata import role_of, setup_of, source_of
from napari_shadowinv.io import public_images

SHOTS = ("toroid", "toroid_with_caustics", "four_toroids", "coaxial_line")


@pytest.mark.parametrize("name", [*SHOTS, "wakefield_run"])
def test_each_opens_with_its_setup_and_a_beam_that_has_its_light(viewer, name):
    layers = by_role(viewer.open_sample("napari-shadowinv", name))
    for layer in layers.values():
        assert isinstance(setup_of(layer), (ProtonSetup, OpticalSetup))
        assert {str(unit) for unit in layer.units[-2:]} == {"micrometer"}
    beam = source_of(layers["shot"])
    np.testing.assert_array_equal(layers["source"].data, beam)
    # Only what is thrown out of the image is missing.
    share = np.asarray(layers["shot"].data[..., :, :]).mean() / beam.mean()
    assert 0.95 < share < 1.005


def test_caustics_are_where_the_name_promises_them_in_flat_beams():
    (beam, (below, _, _)), (second_beam, (image, _, _)) = (
        (make()[0][0], make()[-1]) for make in (samples.toroid, samples.toroid_with_caustics)
    )
    assert np.ptp(beam) == np.ptp(second_beam) == 0
    assert image.max() > 8 * image.mean()
    assert below.max() < 8 * below.mean()


def test_two_energies_are_one_object_in_one_beam_that_is_not_told(viewer):
    films = viewer.open_sample("napari-shadowinv", "two_energies")
    setups = [setup_of(film) for film in films]
    assert [setup.energy for setup in setups] == [14.7, 3.0]
    assert setups[0].object_pixel_size == setups[1].object_pixel_size
    assert [role_of(film) for film in films] == ["shot", "shot"]
    assert {str(unit) for film in films for unit in film.units[-2:]} == {"micrometer"}
    assert all(source_of(film) is None for film in films)
    # Corners show the beam: uneven by tens of per cent, and alike in both films but for a factor.
    ends = slice(None, 12), slice(-12, None)
    corners = [[film.data[row, column].mean() for row in ends for column in ends] for film in films]
    shares = np.array(corners) / np.mean(corners, axis=1, keepdims=True)
    assert np.ptp(shares[0]) > 0.2
    np.testing.assert_allclose(shares[0], shares[1], atol=0.05)


def test_the_same_sample_is_the_same_every_time():
    for make in (samples.four_toroids, samples.coaxial_line, samples.two_energies):
        np.testing.assert_array_equal(make()[-1][0], make()[-1][0])


def test_the_run_is_lazy_and_changes_with_time():
    *_, (stack, keywords, _) = samples.wakefield_run()
    assert type(stack).__module__.startswith("dask")
    assert len(stack) == 20
    assert stack.numblocks == (20, 1, 1)
    assert keywords["axis_labels"] == ("shot", "y", "x")
    planes = stack[[2, 10]].compute()
    contrast = planes.std(axis=(1, 2)) / planes.mean(axis=(1, 2))
    assert contrast[1] > 1.5 * contrast[0]
    low, high = keywords["contrast_limits"]
    assert low < planes.mean() < high


def test_without_a_network_the_menu_says_so_once(
    make_napari_viewer, in_loop, messages, tmp_path, monkeypatch
):
    from napari._app_model import get_app_model

    name = next(name for name in public_images.PUBLIC_FILES if name.startswith("burner/"))
    file = public_images.PUBLIC_FILES[name] | {"address": f"http://127.0.0.1:9/{name}"}
    monkeypatch.setitem(public_images.PUBLIC_FILES, name, file)
    monkeypatch.setattr("pooch.os_cache", lambda name: tmp_path)
    window = make_napari_viewer()
    in_loop(lambda: get_app_model().commands.execute_command("napari-shadowinv.burner").result())
    (message,) = messages
    start = f"{Path(name).name} could not be downloaded (no connection): connect to the network, or"
    assert message.startswith(start)
    assert "\n" not in message
    assert not window.layers


def test_the_burner_comes_with_its_reference(viewer, burner, monkeypatch):
    monkeypatch.setattr(samples, "fetch_burner", lambda: burner[:2])
    layers = by_role(viewer.open_sample("napari-shadowinv", "burner"))
    reference, frame = (read(path).image for path in burner[:2])
    np.testing.assert_array_equal(layers["shot"].data, frame)
    np.testing.assert_array_equal(source_of(layers["shot"]), reference)
