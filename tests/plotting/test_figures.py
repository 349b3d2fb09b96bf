import dataclasses
import sys
from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
from matplotlib import rc_context, rcParams
from matplotlib.figure import Figure

from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.facts import Assessment, Verdict
from napari_shadowinv.fitting import Fit
from napari_shadowinv.inversion import Inversion
from napari_shadowinv.physics.setup import OpticalSetup, ProtonSetup
from napari_shadowinv.physics.units import shown_fields
from napari_shadowinv.plotting import (
    comparison_figure,
    fit_figure,
    report_figure,
    save_figure,
)
from napari_shadowinv.plotting._panels import ALARM_COLOUR

Make = Callable[..., Inversion]

MakeFit = Callable[..., Fit]

SHAPES = [(60, 60), (58, 72), (30, 120), (120, 30)]


def titles(figure: Figure) -> list[str]:
    return [axes.get_title(loc="left") for axes in figure.axes if axes.get_title(loc="left")]


def panels(figure: Figure) -> list[Any]:
    return [axes for axes in figure.axes if axes.get_title(loc="left")]


def assert_nothing_overlaps(figure: Figure) -> None:
    boxes = [axes.get_tightbbox() for axes in panels(figure)]
    texts = [text.get_window_extent() for text in figure.texts]
    page = figure.bbox
    for box in boxes + texts:
        assert page.x0 <= box.x0
        assert box.x1 <= page.x1
        assert page.y0 <= box.y0
        assert box.y1 <= page.y1
    for first, second in combinations(boxes + texts, 2):
        assert not first.overlaps(second)


@pytest.mark.parametrize(
    ("shape", "with_setup"), [((60, 60), False), *((shape, True) for shape in SHAPES[1:])]
)
def test_no_panel_touches_another_or_leaves_the_page(
    make_inversion: Make, shape: tuple[int, int], with_setup: bool, proton_setup: ProtonSetup
) -> None:
    inversion = make_inversion(
        shape, converged=False, cautions=(Caution("flux", "a long warning " * 20),)
    )
    figure = report_figure(
        inversion.in_units(proton_setup if with_setup else None), title="Shot 42"
    )
    assert len(panels(figure)) == 6
    assert_nothing_overlaps(figure)
    for axes in panels(figure)[:5]:  # pixels are square
        box = axes.get_window_extent()
        assert box.height / box.width == pytest.approx(shape[0] / shape[1], rel=0.01)


def test_units_are_on_every_axis_and_colour_bar(
    inversion: Inversion, proton_setup: ProtonSetup, optical_setup: OpticalSetup
) -> None:
    for setup, length, quantity in (
        (None, "px", "px"),
        (proton_setup, "µm", "T·m"),
        (optical_setup, "µm", "rad"),
    ):
        figure = report_figure(inversion.in_units(setup))
        for axes in panels(figure)[:5]:
            assert axes.get_xlabel() == f"x ({length})"
            assert axes.get_ylabel() == f"y ({length})"
            (bar,) = axes.child_axes
            assert bar.get_ylabel()
        field = panels(figure)[2].child_axes[0].get_ylabel()
        assert quantity in field
        assert panels(figure)[5].get_xlabel() == f"Position ({length})"
        assert panels(figure)[5].get_ylabel() == field


def test_field_is_shown_in_si(inversion: Inversion, proton_setup: ProtonSetup) -> None:
    axes = panels(report_figure(inversion.in_units(proton_setup)))[2]
    unit = axes.child_axes[0].get_ylabel().rpartition("(")[2].rstrip(")")
    factor = {"T·m": 1, "mT·m": 1e3, "µT·m": 1e6}[unit]
    expected = np.hypot(*proton_setup.path_integrated_b(inversion.displacement)) * factor
    np.testing.assert_allclose(axes.images[0].get_array(), expected)
    x_min, x_max, y_max, y_min = axes.images[0].get_extent()
    assert (x_min, x_max) == pytest.approx((-0.5 * 1.5, 31.5 * 1.5))
    assert (y_min, y_max) == pytest.approx((-0.5 * 1.5, 23.5 * 1.5))


def test_residual_limits_are_symmetric_in_percent(inversion: Inversion) -> None:
    axes = panels(report_figure(inversion))[4]
    low, high = axes.images[0].get_clim()
    assert low == -high
    percent = 100 * inversion.residual / inversion.image.mean()
    np.testing.assert_allclose(axes.images[0].get_array(), percent)


def test_image_and_reprojection_share_a_scale(inversion: Inversion) -> None:
    image, reprojection = (panels(report_figure(inversion))[index] for index in (0, 3))
    assert image.images[0].get_clim() == reprojection.images[0].get_clim()


def test_figure_shows_sites_warnings_and_failure(make_inversion: Make) -> None:
    good = report_figure(make_inversion((30, 30)))
    bad = report_figure(
        make_inversion(
            (30, 30), converged=False, cautions=(Caution("not-converged", "it is wrong"),)
        )
    )
    text = " ".join(item.get_text() for item in good.texts)
    assert "Image residual: 1.7 %" in text
    assert "Sites" not in text
    assert "1 negative pixel was set to zero" in text
    assert "did not converge" not in text
    assert "did not converge" in " ".join(item.get_text() for item in bad.texts)


def test_masked_pixels_are_blank_in_all_pictures(make_inversion: Make) -> None:
    calm = make_inversion((30, 30))
    mask = np.ones((30, 30), bool)
    mask[4:9, 20:26] = False
    figure = report_figure(Inversion(**{**vars(calm), "mask": mask}))
    for panel in panels(figure)[:5]:
        values = panel.images[0].get_array()
        np.testing.assert_array_equal(np.ma.getmaskarray(np.ma.masked_invalid(values)), ~mask)


def test_figure_has_the_headline_of_the_inversion(make_inversion: Make) -> None:
    inversion = make_inversion((30, 30))
    text = " ".join(item.get_text() for item in report_figure(inversion).texts)
    assert inversion.headline.text in text


def test_empty_field_is_no_error(make_inversion: Make) -> None:
    calm = make_inversion((20, 20))
    still = {
        name: np.zeros_like(getattr(calm, name))
        for name in ("potential", "displacement", "residual", "caustic")
    }
    figure = report_figure(Inversion(**{**vars(calm), **still}))
    figure.canvas.draw()
    assert panels(figure)[2].images[0].get_clim() == (0, 1)


def test_comparison_has_one_scale(inversion: Inversion, proton_setup: ProtonSetup) -> None:
    fields = {"True": inversion.displacement, "Half": inversion.displacement / 2}
    figure = comparison_figure(fields, proton_setup)
    first, second, cuts = panels(figure)
    assert titles(figure)[:2] == ["True", "Half"]
    assert first.images[0].get_clim() == second.images[0].get_clim()
    ratio = second.images[0].get_array().max() / first.images[0].get_array().max()
    assert ratio == pytest.approx(0.5)
    assert [line.get_label() for line in cuts.lines] == ["True", "Half"]
    with pytest.raises(InputError, match="shapes"):
        comparison_figure({"True": np.zeros((2, 5, 5)), "Other": np.zeros((2, 5, 6))})


def test_saved_figure_has_page_size_and_replaces_on_request(
    tmp_path: Path, inversion: Inversion, dots_per_inch: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("napari_shadowinv.plotting.figures.DOTS_PER_INCH", dots_per_inch)
    figure = report_figure(inversion)
    path = save_figure(tmp_path / "report.png", figure)
    width, height = figure.get_size_inches() * 160
    assert iio.imread(path).shape[:2] == (int(height), int(width))
    with pytest.raises(FileFormatError, match="exists"):
        save_figure(path, figure)
    save_figure(path, figure, overwrite=True)
    assert list(tmp_path.iterdir()) == [path]


def test_the_users_matplotlibrc_changes_no_figure(inversion: Inversion, tmp_path: Path) -> None:
    theirs = {
        "text.usetex": True,
        "font.family": "No Such Font",
        "font.size": 30.0,
        "axes.grid": True,
        "image.origin": "lower",
        "image.cmap": "jet",
        "savefig.bbox": "tight",
        "savefig.transparent": True,
    }
    usual = save_figure(tmp_path / "usual.png", report_figure(inversion))
    with rc_context(theirs):
        under_theirs = save_figure(tmp_path / "theirs.png", report_figure(inversion))
        assert rcParams["font.size"] == 30.0
    np.testing.assert_array_equal(iio.imread(under_theirs), iio.imread(usual))


def test_no_window_system_is_touched(inversion: Inversion) -> None:
    before = "matplotlib.pyplot" in sys.modules
    report_figure(inversion)
    assert ("matplotlib.pyplot" in sys.modules) == before


# Fits


def setups_of(proton_setup: ProtonSetup, count: int) -> tuple[ProtonSetup, ...]:
    return tuple(proton_setup.model_copy(update={"energy": 3.0 + k}) for k in range(count))


@pytest.mark.parametrize(
    ("shape", "count", "names"),
    [
        ((60, 60), 1, ("B",)),
        ((58, 72), 2, ("B", "E")),
        ((30, 120), 5, ("B",)),
        ((30, 120), 2, ("B", "E")),
        ((120, 30), 5, ("B",)),
        ((120, 30), 2, ("B", "E")),
    ],
)
def test_no_panel_of_a_fit_touches_another(
    make_fit: MakeFit,
    proton_setup: ProtonSetup,
    shape: tuple[int, int],
    count: int,
    names: tuple[str, ...],
) -> None:
    fit = make_fit(
        shape,
        names,
        (1.0, 1.2, 1.4, 1.6, 1.8)[:count],
        setups=setups_of(proton_setup, count),
        assessment=Assessment(Verdict.MISFIT, "a long explanation " * 20),
    )
    figure = fit_figure(fit, title=", ".join(["some_shot_of_the_night.tif"] * count))
    assert_nothing_overlaps(figure)
    assert len(figure.axes) == len(panels(figure))  # no panel is empty


def test_a_fit_shows_each_image_its_explanation_and_the_field(
    make_fit: MakeFit, proton_setup: ProtonSetup
) -> None:
    fit = make_fit(setups=setups_of(proton_setup, 2))
    panel_titles = titles(fit_figure(fit))
    assert panel_titles == [
        "Image 1: 3 MeV proton", "Re-projection", f"Residual: χ² {fit.chi2[0]:.3g}",
        "Image 2: 4 MeV proton", "Re-projection", f"Residual: χ² {fit.chi2[1]:.3g}",
        "Path-integrated field", "Standard deviation", "Cuts through the peak",
    ]  # fmt: skip
    # A beam that is not uniform comes first, and leaves room for the potential.
    beam = np.linspace(2, 4, fit.source.size).reshape(fit.source.shape)
    panel_titles = titles(fit_figure(dataclasses.replace(fit, source=beam)))
    assert (panel_titles[0], panel_titles[4], panel_titles[8]) == (
        "Beam",
        "Beam",
        "Deflection potential",
    )


def test_residuals_are_over_the_noise_of_each_image_or_pixel(make_fit: MakeFit) -> None:
    fit = make_fit()
    pixels = np.linspace(0.01, 0.1, fit.images.size).reshape(fit.images.shape)
    for noise, sigma in ((np.array([0.02, 0.04]), [0.02, 0.04]), (pixels, pixels)):
        figure = fit_figure(dataclasses.replace(fit, noise=noise))
        for k, index in enumerate((2, 5)):
            drawn = np.ma.filled(panels(figure)[index].images[0].get_array(), np.nan)
            expected = np.where(fit.mask[k], fit.residual[k] / sigma[k], np.nan)
            np.testing.assert_allclose(drawn, expected)


def test_fields_and_error_bars_of_a_fit_are_in_si(
    make_fit: MakeFit, proton_setup: ProtonSetup
) -> None:
    fit = make_fit(names=("B", "E"), setups=(proton_setup, proton_setup))
    axes_list = panels(fit_figure(fit))
    labels = [axes.child_axes[0].get_ylabel() for axes in axes_list[6:8] + axes_list[9:11]]
    assert labels == ["|∫B×dz| (µT·m)", "σ of |∫B×dz| (µT·m)", "|∫E dz| (kV)", "σ of |∫E dz| (kV)"]
    field = fit.fields[0]
    assert field.errors.per_pixel is not None
    error = np.hypot(*proton_setup.path_integrated_b(field.errors.per_pixel)) * 1e6
    np.testing.assert_allclose(axes_list[7].images[0].get_array(), error)
    # The band of the cut along x, at the peak: the error along the field.
    (in_si,) = shown_fields([field.displacement], proton_setup)
    row, column = in_si.peak
    direction = field.displacement[:, row, column] / np.hypot(*field.displacement[:, row, column])
    expected = np.hypot(*(direction * field.errors.per_pixel[:, row, column]))
    expected *= proton_setup.path_integrated_b([[0.0], [1.0]])[0, 0] * -1e6
    band = axes_list[8].collections[0].get_paths()[0].vertices
    place = column * proton_setup.object_pixel_size * 1e6
    heights = band[np.isclose(band[:, 0], place)][:, 1]
    assert np.ptp(heights) / 2 == pytest.approx(expected)


def test_the_verdict_of_a_fit_is_on_top_in_its_colour(make_fit: MakeFit) -> None:
    good = make_fit()
    bad = dataclasses.replace(good, assessment=Assessment(Verdict.SEVERAL, "two fields explain it"))
    colours = []
    for fit in (good, bad):
        (line,) = [
            text
            for text in fit_figure(fit, title="Shot").texts
            if text.get_text().startswith(fit.verdict.capitalize())
        ]
        assert fit.explanation in line.get_text()
        colours.append(line.get_color())
    assert colours == ["#1b6e3c", "#b35c00"]


def test_a_fit_without_error_bars_or_misfit_is_no_error(make_fit: MakeFit) -> None:
    fit = make_fit()
    calm = tuple(
        dataclasses.replace(
            field,
            potential=0 * field.potential,
            displacement=0 * field.displacement,
            errors=None,
        )
        for field in fit.fields
    )
    still = dataclasses.replace(fit, fields=calm, residual=0 * fit.residual, chi2=0 * fit.chi2)
    figure = fit_figure(still)
    figure.canvas.draw()
    assert titles(figure)[-3:] == ["Deflection potential", "Displacement", "Cuts through the peak"]


def hatched(axes: Any) -> list[Any]:
    """Filled contours with hatches, and the note in the corner."""
    return [each for each in axes.collections if getattr(each, "hatches", None) == ["///"]]


def test_pixels_outside_structures_are_hatched(inversion: Inversion, make_fit: MakeFit) -> None:
    std = np.full_like(inversion.displacement, 0.02)
    certain = replace(inversion, errors=replace(inversion.errors, per_pixel=std))
    fit = make_fit()
    for figure, number, structures in (
        (report_figure(certain), 2, certain.structures),
        (fit_figure(fit), 6, fit.structures(fit.fields[0])),
    ):
        assert structures is not None
        assert 0 < structures.share < 1
        axes = panels(figure)[number]
        (region,) = hatched(axes)
        (path,) = region.get_paths()
        for row, column in ((2, 3), np.argwhere(structures.labels > 0)[len(std)]):
            assert path.contains_point((column, row)) == (structures.labels[row, column] == 0)
        assert "hatched: no structure above 2 σ" in [text.get_text() for text in axes.texts]
        assert len([axes for axes in panels(figure) if hatched(axes)]) == 1


def test_nothing_is_hatched_without_errors_of_pixels(inversion: Inversion) -> None:
    assert not any(hatched(axes) for axes in panels(report_figure(inversion)))


def test_a_field_within_its_errors_is_an_alarm_below_the_figure(inversion: Inversion) -> None:
    std = np.full_like(inversion.displacement, 100.0)
    errors = replace(inversion.errors, per_pixel=std)
    figure = report_figure(replace(inversion, errors=errors))
    (text,) = [each for each in figure.texts if "no structure stands above 2 σ" in each.get_text()]
    assert text.get_color() == ALARM_COLOUR
