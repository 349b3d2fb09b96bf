"""Facts about a pack from its scans to fluences, and the messages about its faults."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile
from scipy import ndimage

from helpers.public_data import public_file
from napari_shadowinv.errors import FileFormatError, InputError, InversionCancelled
from napari_shadowinv.film import Pack, read_corners, write_corners
from napari_shadowinv.film.registration import move_corners
from napari_shadowinv.film.scans import upright
from napari_shadowinv.film_doses import FilmDoses
from napari_shadowinv.io import read, read_toml, write
from napari_shadowinv.pipeline import read_pack, run_film, write_layers
from napari_shadowinv.pipeline._film import _pixel_cautions
from napari_shadowinv.pipeline.shot_table import table_rows
from simulated_pack import Truth, simulate

SHAPE, COUNT = (120, 160), 4


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Truth:
    folder = tmp_path_factory.mktemp("pack")
    return simulate(folder, layers=COUNT, shape=SHAPE, seed=4, slips=2.0, b_peak=2.0, e_peak=1.0)


@pytest.fixture(scope="module")
def doses(truth: Truth):
    return run_film(read_pack(truth.pack))


@pytest.fixture
def changed(truth: Truth, tmp_path: Path) -> Callable[..., Path]:
    """The pack with something else in its file, or before it; its scans belong to `truth`."""

    def write_pack(*replaced: tuple[str, str], first: str = "") -> Path:
        text = truth.pack.read_text()
        for old, new in replaced:
            assert old in text
            text = text.replace(old, new, 1)
        for file in truth.folder.glob("*.[tc]*"):
            if not (tmp_path / file.name).exists():
                (tmp_path / file.name).symlink_to(file)
        pack = tmp_path / "changed.toml"
        pack.write_text(f"{first}\n{text}")
        return pack

    return write_pack


@pytest.fixture
def filmed(changed: Callable[..., Path]) -> Callable[..., FilmDoses]:
    """The doses of a pack with something else in its file, or before it."""
    return lambda *replaced, first="": run_film(read_pack(changed(*replaced, first=first)))


def scan_again(pack: Path, name: str, scan: np.ndarray, per_inch: int = 300) -> None:
    """Replace a scan beside a changed pack; that of `truth` stays."""
    (pack.parent / name).unlink()
    kind = "rgb" if scan.ndim == 3 else "minisblack"
    dots = {"resolution": (per_inch, per_inch), "resolutionunit": "INCH"}
    tifffile.imwrite(pack.parent / name, scan, photometric=kind, **dots)


def sentences_of(doses: FilmDoses) -> str:
    return "; ".join(caution.text for caution in doses.cautions)


def laid(truth: Truth, doses, layer: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions and middle of the upright film on its scan, after its shift and turn."""
    scale = truth.scene.magnifications[layer] / truth.scene.magnifications[0]
    pose = doses.shifts[layer], float(doses.turns[layer])
    return upright(move_corners(doses.corners[layer], *pose, scale))[:2]


def on_films(truth: Truth, doses, plane: Callable[[int], np.ndarray], layer: int) -> np.ndarray:
    """Return the truth on a film's pixels, as the doses's pixels lie on it."""
    axes, middle = laid(truth, doses, layer)
    place = truth.placements[layer]
    scale = truth.scene.magnifications[layer] / truth.scene.magnifications[0]
    steps = np.moveaxis(np.indices((doses.dose.shape[1], doses.dose.shape[2]), dtype=float), 0, -1)
    steps -= (np.array(steps.shape[:2]) - 1) / 2
    on_scan = scale * steps @ axes + middle
    at = (on_scan - np.array(place.middle)) @ np.array(place.axes).T
    at += truth.scene.middle + np.array(place.slip)
    return ndimage.map_coordinates(plane(layer), np.moveaxis(at, -1, 0), order=3, mode="nearest")


def test_doses_equal_the_exposure_of_the_films(truth: Truth, doses) -> None:
    scales = truth.scene.magnifications / truth.scene.magnifications[0]
    for layer in range(COUNT):
        usable = doses.usable[layer]
        assert usable[20:-20, 20:-20].mean() > 0.85
        # As on the first film: behind it the same protons cover more.
        dose = doses.dose[layer] / scales[layer] ** 2
        error = doses.dose_error[layer] / doses.dose[layer]
        ratio = (dose / on_films(truth, doses, truth.dose, layer))[usable]
        assert ratio.mean() == pytest.approx(1, abs=0.005)
        assert (ratio - 1).std() == pytest.approx(np.sqrt((error[usable] ** 2).mean()), rel=0.3)


def test_fluences_equal_the_beam(truth: Truth, doses) -> None:
    scene = truth.scene
    scales = scene.magnifications / scene.magnifications[0]
    for layer in range(COUNT - 1):
        usable = doses.usable[layer]
        true = on_films(truth, doses, scene.fluence, layer) * scales[layer] ** 2
        away = doses.fluence[layer] - true
        assert abs(away[usable].mean()) < 0.02 * true.mean()
        error = doses.fluence_error[layer]
        assert (away / error)[usable].std() == pytest.approx(1, abs=0.35)
    np.testing.assert_allclose(doses.bands[:, 0], scene.energies, rtol=1e-3)
    assert (doses.bands[:, 1] < doses.bands[:, 0]).all()
    assert (doses.bands[:, 0] <= doses.bands[:, 2]).all()


def test_films_lie_on_each_other(truth: Truth, doses) -> None:
    places = places_of(truth, doses)
    assert (np.abs(places - places.mean(axis=0))[:, :2] < 0.6).all()
    assert (np.abs(places[:, 2]) < 0.012).all()
    # The edges alone leave them where the pack left them.
    slips = np.array([place.slip for place in truth.placements])
    assert np.abs(slips - slips.mean(axis=0)).max() > 1.5
    assert doses.by_images.all()
    assert "fields shift that content too" in sentences_of(doses)
    assert np.abs(doses.shifts).max() > 0.5
    np.testing.assert_allclose(doses.corners, truth.corners, atol=0.1)


def test_the_setups_know_energy_depth_and_pixel(truth: Truth, doses, tmp_path: Path) -> None:
    table = write_layers(doses, tmp_path / "layers")[-1]
    rows = table_rows(table)
    assert [row.file.name for row in rows] == [f"layer_{k:02d}.tif" for k in range(1, COUNT + 1)]
    for layer, row in enumerate(rows):
        setup = read_toml(row.setup)
        assert setup["energy"] == pytest.approx(doses.energies[layer])
        assert setup["pixel_size"] == pytest.approx(truth.scene.pixel_size, rel=1e-3)
        assert setup["object_image_distance"] == pytest.approx(truth.scene.distances[layer])
        used = doses.usable[layer]
        np.testing.assert_array_equal(read(row.mask).image > 0, used)
        image = read(row.file).image
        np.testing.assert_allclose(image[used], doses.fluence[layer][used], rtol=1e-6)
    first, last = doses.times_of_flight[:: COUNT - 1]
    assert 0.4e-9 < first < 0.42e-9
    assert last < first


def test_a_spectrum_is_the_mean_of_usable_pixels(doses) -> None:
    region = np.zeros(doses.dose.shape[1:], bool)
    region[30:50, 10:40] = True
    for inside in (None, region):
        spectrum = doses.spectrum(inside)
        for k in range(COUNT):
            used = doses.usable[k] & (True if inside is None else inside)
            fluence = doses.fluence[k][used].astype(float)
            assert spectrum.fluence[k] == pytest.approx(fluence.mean(), rel=1e-12)
            assert spectrum.error[k] == np.median(doses.fluence_error[k][used])
    assert np.isnan(doses.spectrum(np.zeros_like(region)).fluence).all()


def test_it_is_written_and_read(doses, tmp_path: Path) -> None:
    path = write(tmp_path / "pack.shadowinv", doses)
    labelled, again = doses.to_dataset(), read(path)
    for name in ("y", "x"):
        assert labelled[name].attrs["units"] == "m"
        places = doses.pixel_size * np.arange(labelled.sizes[name])
        np.testing.assert_allclose(labelled[name], places)
    assert again.attrs == labelled.attrs
    for name in labelled.variables:
        np.testing.assert_array_equal(again[name], labelled[name])
    rebuilt = FilmDoses.from_dataset(again)
    assert rebuilt.facts == doses.facts
    assert rebuilt.headline == doses.headline
    assert (rebuilt.pack, rebuilt.setups) == (doses.pack, doses.setups)
    with pytest.raises(FileFormatError, match=r"pack.h5.*expected"):
        write(tmp_path / "pack.h5", doses)


def test_one_scan_of_all_films(truth: Truth, doses, changed) -> None:
    scans = [tifffile.imread(file) for file in truth.files]
    rows = [np.concatenate(scans[k : k + 2], axis=1) for k in (0, 2)]
    pack = changed(
        *[(f'file = "film_{k:02d}.tif"\n', "") for k in range(1, COUNT + 1)],
        first='scan = "all.tif"',
    )
    joint_scan = pack.parent / "all.tif"
    dots = {"resolution": (300, 300), "resolutionunit": "INCH"}
    tifffile.imwrite(joint_scan, np.concatenate(rows), photometric="rgb", **dots)
    result = run_film(read_pack(pack))
    inner = np.s_[:, 20:-20, 20:-20]
    from_joint, separate = result.dose[inner], doses.dose[inner]
    assert np.median(np.abs(from_joint / separate - 1)) < 0.01
    missing = pack.read_text().replace("[[layers]]", '[[layers]]\nfilm = "HDV2"\n\n[[layers]]', 1)
    pack.write_text(missing)
    with pytest.raises(InputError, match="shows 4 films, the pack has 5 layers"):
        run_film(read_pack(pack))


def test_a_lost_film_is_bridged(truth: Truth, doses, changed) -> None:
    pack = read_pack(changed(('file = "film_02.tif"', "exclude = true")))
    result = run_film(pack)
    assert not result.usable[1].any()
    assert np.isnan(result.dose[1]).all()
    with_film, bridged = doses.fluence[1], result.fluence[1]
    if len(with_film) == len(bridged) + 1:  # films behind the first are smaller on it
        with_film = (with_film[1:] + with_film[:-1]) / 2
    inner = np.s_[30:-30, 30:-30]
    assert abs(np.median(bridged[inner] / with_film[inner]) - 1) < 0.15
    assert np.isnan(result.corners[1]).all()


@pytest.mark.parametrize(
    ("numbers", "is_doubtful"),
    [((72, 96, 180, 240, 20, 25, 30_000), True), ((75, 150, 300, 508, 1200, 25_400 / 75), False)],
)
def test_resolution_unlike_a_scanner_is_doubted(changed, numbers, is_doubtful) -> None:
    pack = read_pack(changed())
    for per_inch in numbers:
        cautions = _pixel_cautions(pack, 25.4e-3 / per_inch)
        assert [caution.code for caution in cautions] == ["film-pixels"] * is_doubtful
    assert not _pixel_cautions(pack.model_copy(update={"pixel_size": 1e-4}), 1e-4)


def test_scans_saved_again_by_a_picture_program_are_doubted(truth: Truth, doses, changed) -> None:
    pack = changed()
    for file in truth.files:
        scan_again(pack, file.name, tifffile.imread(file), per_inch=72)
    by_program = run_film(read_pack(pack))
    assert "72 dots per inch (pixels of 352.8 µm)" in sentences_of(by_program)
    codes = [{caution.code for caution in each.cautions} for each in (by_program, doses)]
    assert ["film-pixels" in each for each in codes] == [True, False]


@pytest.mark.parametrize("way", [np.s_[::-1, ::-1], np.s_[:, ::-1]])
def test_films_laid_another_way_round(truth: Truth, doses, changed, way) -> None:
    pack = changed()
    scan = tifffile.imread(truth.files[1])[way]
    scan_again(pack, "film_02.tif", scan)
    entry = "turned = 180" if len(way) == 2 and way[0].step == -1 else "mirrored = true"
    with pytest.raises(InputError, match=f"film [23] does not lie as film [12] does.*{entry}"):
        run_film(read_pack(pack))
    right = changed(('file = "film_02.tif"', f'file = "film_02.tif"\n{entry}'))
    result = run_film(read_pack(right))
    np.testing.assert_allclose(result.dose, doses.dose, rtol=1e-3)
    # Corners are those on the scan as it is.
    height, width = scan.shape[:2]
    sizes = np.array([height, width]) - 1
    flips = np.array([way[0].step == -1, True])
    on_scan = np.where(flips, sizes - result.corners[1], result.corners[1])
    want = doses.corners[1]
    gap = np.linalg.norm(on_scan[:, None] - want[None], axis=-1).min(axis=1)
    assert gap.max() < 0.1


def test_films_seen_from_the_detector_are_mirrored(truth: Truth, doses, changed) -> None:
    pack = changed(('seen_from = "source"', 'seen_from = "detector"'))
    for file in truth.files:
        scan = tifffile.imread(file)[:, ::-1]
        scan_again(pack, file.name, scan)
    result = run_film(read_pack(pack))
    np.testing.assert_allclose(result.dose, doses.dose, rtol=1e-3)
    assert "from the detector, mirrored" in result.pack.seen_from_text
    # Corners are those on the scans as they are.
    width = scan.shape[1]
    expected = doses.corners[:, [1, 0, 3, 2]] * [1, -1] + [0, width - 1]
    np.testing.assert_allclose(result.corners, expected, atol=0.1)


def test_the_side_of_the_films_is_asked_for(truth: Truth, filmed) -> None:
    result = filmed(('seen_from = "source"\n', ""))
    assert "B has the wrong sign; state the side" in sentences_of(result)
    assert result.pack.seen_from_text == "the source (assumed)"


def test_corners_from_a_table(truth: Truth, doses, filmed, tmp_path: Path) -> None:
    table, first = tmp_path / "corners.csv", 'corners = "corners.csv"\n'

    def write_table(corners) -> None:
        write_corners(table, dict(zip("1234", corners, strict=True)))

    write_table(truth.corners)
    result = filmed(first=f'{first}align = "edges"')
    np.testing.assert_allclose(result.corners, truth.corners, atol=0.01)
    assert not result.by_images.any()
    # Those that were found change nothing; shifts are found again, and the warnings they bring.
    write_table(doses.corners)
    result = filmed(first=first)
    np.testing.assert_allclose(result.shifts, doses.shifts, atol=0.05)
    assert "fields shift that content too" in sentences_of(result)
    assert len(result.cautions) == len(doses.cautions)
    inside = np.array(truth.corners)
    inside[2, 2] -= 30
    write_table(inside)
    with pytest.raises(InputError, match=r"the corners of film 3 are up to \d+ px from those of a"):
        filmed(first=first)
    write_corners(table, {"7": truth.corners[0]})
    with pytest.raises(InputError, match="corners of a film '7': expected numbers of layers"):
        filmed(first=first)
    assert read_corners(table).keys() == {"7"}


def write_fiducials(path: Path, truth: Truth, films: range, *, mirrored: int = -1) -> None:
    """Three marks through the pack, where they are on the scans; one film lies on its face."""
    through = {"left": (-30.0, -50.0), "right": (-20.0, 55.0), "low": (40.0, 5.0)}
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["film", "name", "y", "x"])
        for layer in films:
            place = truth.placements[layer]
            for name, at in through.items():
                y, x = place.on_scan(np.array(at) - np.array(place.slip))
                x = place.shape[1] - 1 - x if layer == mirrored else x
                rows.writerow([layer + 1, name, f"{y:.3f}", f"{x:.3f}"])


def places_of(truth: Truth, doses) -> np.ndarray:
    """Where the middles of the upright films are in the pack, px, and how they are turned."""
    places = []
    for layer, place in enumerate(truth.placements[: doses.dose.shape[0]]):
        axes, middle = laid(truth, doses, layer)
        away = np.array(place.axes) @ (middle - np.array(place.middle)) + np.array(place.slip)
        turn = np.arctan2(axes[0, 1], axes[0, 0]) - np.arctan2(*place.axes[0][::-1])
        places.append([*away, turn])
    return np.array(places)


def test_films_are_laid_on_each_other_by_fiducials(truth: Truth, filmed, tmp_path: Path) -> None:
    write_fiducials(tmp_path / "fiducials.csv", truth, range(COUNT))
    result = filmed(first='fiducials = "fiducials.csv"')
    places = places_of(truth, result)
    assert (np.abs(places - places.mean(axis=0)) < [0.05, 0.05, 5e-4]).all()
    assert (result.shift_errors < 0.5).all()
    # They distinguish the displacement by fields from films that slipped.
    assert not result.by_images.any()
    assert not result.cautions


def test_deeper_films_are_magnified_about_the_axis(truth: Truth, filmed, tmp_path: Path) -> None:
    """Marks through the pack lie behind each other; rays from the source spread about them."""
    write_fiducials(tmp_path / "fiducials.csv", truth, range(COUNT))
    marks = 'fiducials = "fiducials.csv"'
    about_middle = filmed(first=marks)
    scale = (truth.scene.magnifications / truth.scene.magnifications[0])[-1]
    _, _, size = upright(about_middle.corners[0])
    # So that the last film is shifted by whole px: a point p about the middle is there at p - s.
    shift = np.array([2, -3])
    axis = (size - 1) / 2 + shift / (1 / scale - 1)
    about_axis = filmed(first=f"{marks}\naxis = {axis.tolist()}")
    first, last = (about_axis.dose[k] for k in (0, -1))
    inner = np.s_[20:-20, 20:-20]
    np.testing.assert_allclose(first[inner], about_middle.dose[0][inner], rtol=1e-5)
    expected = np.roll(about_middle.dose[-1], -shift, axis=(0, 1))
    np.testing.assert_allclose(last[inner], expected[inner], rtol=1e-5)
    # Corners do not depend on the centre of magnification: they can be given again.
    np.testing.assert_allclose(about_axis.corners, about_middle.corners, atol=1e-9)
    with pytest.raises(ValueError, match="axis is given and no setup"):
        Pack.model_validate({"layers": [{"film": "HDV2"}], "axis": [1, 2]})


def test_films_without_fiducials_are_reported(truth: Truth, filmed, tmp_path: Path) -> None:
    write_fiducials(tmp_path / "fiducials.csv", truth, range(COUNT - 1))
    result = filmed(first='fiducials = "fiducials.csv"')
    places = places_of(truth, result)[:-1]
    assert np.ptp(places[:, :2], axis=0).max() < 0.1
    assert f"films {COUNT} have no fiducials and were aligned by their edges" in sentences_of(
        result
    )
    np.testing.assert_array_equal(result.shifts[-1], 0)


def test_fiducials_of_a_film_on_its_face(truth: Truth, changed, tmp_path: Path) -> None:
    table, first = tmp_path / "fiducials.csv", 'fiducials = "fiducials.csv"'
    write_fiducials(table, truth, range(COUNT))
    before = run_film(read_pack(changed(first=first))).corners[1]
    scan = tifffile.imread(truth.files[1])
    (tmp_path / "film_02.tif").unlink()
    tifffile.imwrite(tmp_path / "film_02.tif", scan[:, ::-1], photometric="rgb")
    write_fiducials(table, truth, range(COUNT), mirrored=1)
    said = ('file = "film_02.tif"', 'file = "film_02.tif"\nmirrored = true')
    pack = read_pack(changed(said, first=f"{first}\npixel_size = 84.667e-6"))
    mirrored = run_film(pack).corners[1]
    as_before = mirrored[[1, 0, 3, 2]] * [1, -1] + [0, scan.shape[1] - 1]
    np.testing.assert_allclose(as_before, before, atol=0.1)


def test_layers_from_a_table(truth: Truth, doses, changed) -> None:
    entries = read_toml(truth.pack)
    pack = changed()
    with (pack.parent / "layers.csv").open("w", newline="") as file:
        lines = csv.writer(file)
        lines.writerow(["film", "filters", "file"])
        lines.writerows(
            [layer["film"], "; ".join(layer.get("filters", [])), layer["file"]]
            for layer in entries["layers"]
        )
    text = pack.read_text()
    pack.write_text('layers = "layers.csv"\n' + text[: text.index("[[layers]]")])
    assert read_pack(pack).layers == read_pack(changed()).layers


def test_it_can_be_cancelled(truth: Truth) -> None:
    with pytest.raises(InversionCancelled):
        run_film(read_pack(truth.pack), should_stop=lambda: True)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda scan: scan[..., 0], "film_01.tif is no picture in colour"),
        (lambda scan: (scan // 257).astype(np.uint8), "film_01.tif has 8 bits per channel, its un"),
        (lambda scan: np.full_like(scan, 64_000), "no film was found on the scan"),
        (lambda scan: np.concatenate([scan, scan]), "film_01.tif shows 2 films, expected one"),
        (lambda scan: scan[::2, ::2], "expected films of one size; correct its corners"),
    ],
)
def test_wrong_scans_are_refused(truth: Truth, changed, spoil, message: str) -> None:
    pack = changed()
    scan = spoil(tifffile.imread(truth.files[0]))
    scan_again(pack, "film_01.tif", scan)
    with pytest.raises((InputError, FileFormatError), match=re.escape(message)):
        run_film(read_pack(pack))


def test_film_that_is_too_dark_is_reported(truth: Truth, filmed) -> None:
    table = 'calibration = "HDV2.csv"\ndose_range = [0.0, 300.0]'
    result = filmed(('calibration = "HDV2.csv"', table))
    assert "of the pixels are darker than the calibration covers" in sentences_of(result)
    inside = result.usable[0]
    assert result.dose[0][inside].max() <= 301


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('file = "film_02.tif"', 'file = "lost.tif"', "lost.tif does not exist"),
        ('file = "film_02.tif"', 'file = "film_01.tif"', "same content as the scan of film 1"),
        ('file = "film_02.tif"', "", "layer 2 has no file: give it, or a 'scan' of all films"),
        ('film = "HDV2"', 'film = "HD-V2"', "under [films]: did you mean 'HDV2'?"),
        ('"13 um Al"', '"13 Al"', "expected thickness, unit (um or mm) and material"),
        ('calibration = "HDV2.csv"\n', "", "films of type 'HDV2' have no calibration"),
        ('kind = "proton"', 'kind = "optical"', "setup is not one of protons"),
        ('kind = "proton"', 'kind = "proton"\nenergy = 3', "the setup has an energy"),
        ("[setup]", "[setups]", "unknown key 'setups', did you mean 'setup'?"),
        (None, "9,left,1,1", "a mark on film 9: expected numbers of layers, from 1 to 4"),
        (None, "1,left,1,1", "the mark 'left' twice on film 1"),
        (None, "1,new,1,one", "line 14: 'x' is 'one'"),
    ],
)
def test_wrong_packs_and_fiducials_are_refused(
    truth: Truth, filmed, tmp_path: Path, old: str | None, new: str, message: str
) -> None:
    write_fiducials(tmp_path / "fiducials.csv", truth, range(COUNT))
    with (tmp_path / "fiducials.csv").open("a") as file:
        file.write("" if old else f"{new}\n")
    changes = [(old, new)] if old else []
    with pytest.raises((InputError, FileFormatError), match=re.escape(message)):
        filmed(*changes, first="" if old else 'fiducials = "fiducials.csv"')


def test_real_films_are_not_moved_by_lines_of_equal_dose() -> None:
    film = {
        "calibration": public_file("rcf/EBT3_2_calibration.csv"),
        "unexposed": public_file("rcf/EBT3.tif"),
    }
    layers = [
        {"film": "EBT3", "filters": "750 um Fe", "file": public_file(f"rcf/RCF_18{letter}.tif")}
        for letter in "OPQ"
    ]
    result = run_film(Pack.model_validate({"layers": layers, "films": {"EBT3": film}}))
    # Edges and the slit that is cut into all of them agree within 2 px.
    assert np.ptp(result.shifts, axis=0).max() < 2
    assert np.ptp(result.turns) < np.deg2rad(0.3)
    assert (result.shift_errors > 2).all()
