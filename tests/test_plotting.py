import sys
from collections.abc import Callable
from itertools import combinations
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
from matplotlib.figure import Figure

from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.inversion import Inversion
from napari_shadowinv.physics.setup import OpticalSetup, ProtonSetup
from napari_shadowinv.plotting import comparison_figure, report_figure, save_figure

Make = Callable[..., Inversion]

SHAPES = [(60, 60), (58, 72), (30, 120), (120, 30)]


def titles(figure: Figure) -> list[str]:
    return [axes.get_title(loc="left") for axes in figure.axes if axes.get_title(loc="left")]


def panels(figure: Figure) -> list[Any]:
    return [axes for axes in figure.axes if axes.get_title(loc="left")]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("with_setup", [False, True])
def test_no_panel_touches_another_or_leaves_the_page(
    make_inversion: Make, shape: tuple[int, int], with_setup: bool, proton_setup: ProtonSetup
) -> None:
    inversion = make_inversion(shape, converged=False, warnings=("a long warning " * 20,))
    figure = report_figure(inversion, proton_setup if with_setup else None, title="Shot 42")
    figure.canvas.draw()
    boxes = [axes.get_tightbbox() for axes in panels(figure)]
    texts = [text.get_window_extent() for text in figure.texts]
    assert len(boxes) == 6
    page = figure.bbox
    for box in boxes + texts:
        assert page.x0 <= box.x0
        assert box.x1 <= page.x1
        assert page.y0 <= box.y0
        assert box.y1 <= page.y1
    for first, second in combinations(boxes + texts, 2):
        assert not first.overlaps(second)


@pytest.mark.parametrize("shape", SHAPES)
def test_pixels_are_square(make_inversion: Make, shape: tuple[int, int]) -> None:
    figure = report_figure(make_inversion(shape))
    figure.canvas.draw()
    for axes in panels(figure)[:5]:
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
        figure = report_figure(inversion, setup)
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
    axes = panels(report_figure(inversion, proton_setup))[2]
    unit = axes.child_axes[0].get_ylabel().rpartition("(")[2].rstrip(")")
    factor = {"T·m": 1, "mT·m": 1e3, "µT·m": 1e6}[unit]
    expected = np.hypot(*proton_setup.path_integrated_b(inversion.displacement)) * factor
    np.testing.assert_allclose(axes.images[0].get_array(), expected)
    left, right, bottom, top = axes.images[0].get_extent()
    assert (left, right) == pytest.approx((-0.5 * 1.5, 31.5 * 1.5))
    assert (top, bottom) == pytest.approx((-0.5 * 1.5, 23.5 * 1.5))


def test_residual_limits_are_symmetric_in_percent(inversion: Inversion) -> None:
    axes = panels(report_figure(inversion))[4]
    low, high = axes.images[0].get_clim()
    assert low == -high
    percent = 100 * inversion.residual / inversion.image.mean()
    np.testing.assert_allclose(axes.images[0].get_array(), percent)


def test_image_and_reprojection_share_a_scale(inversion: Inversion) -> None:
    image, reprojection = (panels(report_figure(inversion))[index] for index in (0, 3))
    assert image.images[0].get_clim() == reprojection.images[0].get_clim()


def test_footer_tells_sites_warnings_and_failure(make_inversion: Make) -> None:
    good = report_figure(make_inversion((30, 30)))
    bad = report_figure(make_inversion((30, 30), converged=False, warnings=()))
    text = " ".join(item.get_text() for item in good.texts)
    assert "17 sites" in text
    assert "1 negative pixel was set to zero" in text
    assert "not converged" not in text
    assert "not converged" in " ".join(item.get_text() for item in bad.texts)


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


def test_saved_figure_has_the_page_size_and_replaces_only_if_asked(
    tmp_path: Path, inversion: Inversion
) -> None:
    figure = report_figure(inversion)
    path = save_figure(tmp_path / "report.png", figure)
    width, height = figure.get_size_inches() * 160
    assert iio.imread(path).shape[:2] == (int(height), int(width))
    with pytest.raises(FileFormatError, match="exists"):
        save_figure(path, figure)
    save_figure(path, figure, overwrite=True)
    assert list(tmp_path.iterdir()) == [path]


def test_no_window_system_is_touched(inversion: Inversion) -> None:
    before = "matplotlib.pyplot" in sys.modules
    report_figure(inversion)
    assert ("matplotlib.pyplot" in sys.modules) == before
