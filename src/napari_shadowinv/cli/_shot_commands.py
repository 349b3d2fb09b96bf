"""Commands for one shot: `invert`, `rerun`, `info` and `demo`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from typer import Exit, Option

from napari_shadowinv.cli import _flags
from napari_shadowinv.cli._inputs import recipe_from, setup_for
from napari_shadowinv.cli._outputs import (
    Outputs,
    check_setup,
    result_and_figure,
)
from napari_shadowinv.cli._settings import FILE_KEYS, INVERSION_SECTIONS, settings_of
from napari_shadowinv.cli._summary import fact_rows, headline_row, result_rows, size_text
from napari_shadowinv.cli._terminal import (
    EXIT_FAILED_SHOTS,
    notify_errors,
    say,
    work_callbacks,
)
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import ResultKind, percent
from napari_shadowinv.io.formats import PNG, RESULT
from napari_shadowinv.physics.beam import displacement_from_potential
from napari_shadowinv.shot import Shot

if TYPE_CHECKING:
    from napari_shadowinv._typing import FloatArray

# Help of arguments, where it is longer than a line.
HELP = {
    "image": "The image, if it has moved or changed; for a fit, all images in their order. "
    "Default: the files named in the result, in its folder or the current one.",
    "rerun_out": "Result file. Default: the result's name with _again, in the current folder.",
    "other_folders": "Also read the files in other folders that the result names.",
    "noise": "Standard deviation of the noise, as a fraction of the mean.",
    "verify": "Compare all files of a store with their checksums; exit code 1 if one is damaged.",
}
_DEMO_PEAK = 97.0  # MG·µm; caustics form from about 185
INVERT_EPILOG = """
shadowinv invert shot.tif --source reference.tif --setup setup.toml --bin 4

shadowinv invert shot.tif --step 'hot-pixels 6' --set options.tolerance=1e-4

Exit codes: 0 success; 2 invalid input; 3 written, but not converged; 130 cancelled.
"""


@notify_errors
@_flags.takes_flags
def invert(
    image: _flags.ImageFile,
    flags: _flags.InversionFlags,
    outputs: Outputs,
    settings: Annotated[
        list[str] | None,
        _flags.setting(INVERSION_SECTIONS, "options.tolerance=1e-4", FILE_KEYS),
    ] = None,
    save_recipe: _flags.SaveRecipe = None,
    out: Annotated[Path | None, Option(help="Result: .shadowinv, .h5 or .csv.")] = None,
    figure: _flags.Figure = None,
) -> None:
    """Retrieve the deflection potential of one image.

    Writes a result with all options, and a figure next to it.
    """
    from napari_shadowinv.io import read_shot
    from napari_shadowinv.pipeline import run, write_recipe

    result, figure = result_and_figure(image, out, figure)
    inputs = [image, flags.recipe, flags.setup]
    outputs.check_result(ResultKind.INVERSION, result, figure, recipe=save_recipe, inputs=inputs)
    recipe = recipe_from(
        flags, settings_of(settings or (), INVERSION_SECTIONS, flags.by_key, FILE_KEYS)
    )
    outputs.protect_files_of(recipe)
    shot = read_shot(image, channel=flags.channel)
    recipe = recipe.model_copy(update={"setup": setup_for(flags.setup, shot, recipe)})
    check_setup(result, recipe.setup)
    outputs.warn_of_setups([(recipe.setup, shot.shape)])
    with work_callbacks(outputs.quiet) as callbacks:
        inversion = run(recipe, shot, **callbacks)
    outputs.write_result(inversion, [str(image)], result, figure)
    if save_recipe is not None:
        write_recipe(save_recipe, recipe, overwrite=outputs.overwrite)
    title = f"{shot.path}, {size_text(inversion.image.shape)}"
    outputs.show(title, result_rows(inversion, shot=shot))
    outputs.exit_unless_sound(inversion, result)


@notify_errors
@_flags.takes_flags
def rerun(
    result: Annotated[Path, _flags.argument(help="A .shadowinv result of this program.")],
    outputs: Outputs,
    image: Annotated[list[Path] | None, _flags.argument(help=HELP["image"])] = None,
    source: Annotated[Path | None, Option(help="The measured source, if it has moved.")] = None,
    out: Annotated[Path | None, Option(help=HELP["rerun_out"])] = None,
    figure: _flags.Figure = None,
    other_folders: Annotated[bool, Option("--other-folders", help=HELP["other_folders"])] = False,
) -> None:
    """Repeat a result from the recipe it contains, and report the changes.

    With the same files and version, the result is identical bit for bit.
    """
    from napari_shadowinv.pipeline.rerun import collect_rerun

    target = out or Path(f"{result.stem}_again{RESULT.suffix}")
    again_out, figure = result_and_figure(result, target, figure)
    inputs = collect_rerun(result, image, source=source, other_folders=other_folders)
    outputs.check_result(inputs.kind, again_out, figure, inputs=[result, *inputs.files])
    outputs.warn_of_setups(
        (shot.setup, getattr(shot.image, "shape", None)) for shot in inputs.shots
    )
    with work_callbacks(outputs.quiet) as callbacks:
        again = inputs.run(**callbacks)
    names = [str(file) for file in inputs.files[: len(inputs.shots)]] or [str(result)]
    outputs.write_result(again.content, names, again_out, figure)
    rows = [
        *[("file", name) for name in names],
        *[("changed", text) for text in again.changes or ("nothing",)],
        ("difference", again.difference),
        headline_row(again.content.headline),
        *fact_rows(again.content.facts),
    ]
    outputs.show("Rerun", rows)
    outputs.exit_unless_sound(again.content, again_out)


@notify_errors
def info(
    file: Annotated[Path, _flags.argument(help="An image, a result or a store.")],
    verify: Annotated[bool, Option("--verify", help=HELP["verify"])] = False,
) -> None:
    """Describe a file and its contents, or the shots of a store and why some failed."""
    from napari_shadowinv.cli import _info
    from napari_shadowinv.io import is_stack

    if is_stack(file):
        from napari_shadowinv.cli._batch import status_table

        table, is_damaged = status_table(file, verify)
        say(table)
        if verify and is_damaged:
            raise Exit(EXIT_FAILED_SHOTS)
        return
    if verify:
        raise InputError(f"{file} is not a stack of shots: --verify describes a store")
    say(_info.file_table(file))


@notify_errors
def demo(
    out: Annotated[Path, Option(help="Output folder.")] = Path("demo"),
    noise: Annotated[float, Option(help=HELP["noise"])] = 0.1,
    settings: Annotated[
        list[str] | None, _flags.setting(INVERSION_SECTIONS, "options.n_sites=6000")
    ] = None,
) -> None:
    """Simulate a proton radiograph of a toroidal field, invert it and compare with the truth.

    The setup follows Kasim et al., arXiv:1607.04179, section IV.
    """
    if not 0 <= noise < float("inf"):
        raise InputError(f"--noise is {noise:g}: it must be 0 or more, as a fraction of the mean")
    from napari_shadowinv.io.files import make_folder

    chosen = recipe_from(
        _flags.InversionFlags(),
        settings_of(settings or (), INVERSION_SECTIONS, {"options.negative": ("", "clip")}),
    )
    make_folder(out)
    from napari_shadowinv.io import write
    from napari_shadowinv.physics.forward import synthetic_image
    from napari_shadowinv.physics.phantoms import toroid
    from napari_shadowinv.physics.poisson import poisson_invert
    from napari_shadowinv.physics.setup import ProtonSetup
    from napari_shadowinv.pipeline import run
    from napari_shadowinv.plotting import comparison_figure, report_figure

    setup = ProtonSetup.example()
    truth = toroid((200, 200), setup, peak=_DEMO_PEAK, sigma=30e-6).displacement
    image = synthetic_image(truth)
    grain = np.random.default_rng(0).normal(size=image.shape)
    image = image + noise * image.mean() * grain
    # The simulated beam is known: it is flat.
    shot = Shot(image, setup, source=np.ones(image.shape))
    with work_callbacks(quiet=False) as callbacks:
        inversion = run(chosen, shot, **callbacks)
    poisson = displacement_from_potential(poisson_invert(image))
    fields = {"True": truth, "Retrieved": inversion.displacement, "Poisson": poisson}
    errors = {name: _error_text(fields[name], truth) for name in ("Retrieved", "Poisson")}
    caption = "Errors: " + "; ".join(f"{field} {error}" for field, error in errors.items())
    name = f"toroid_{_DEMO_PEAK:g}"
    figures = {
        out / f"{name}{PNG.suffix}": lambda: report_figure(inversion, title=f"Demo {name}"),
        out / f"{name}_comparison{PNG.suffix}": lambda: comparison_figure(
            fields, setup, title="True and retrieved", caption=caption
        ),
    }
    result = write(out / f"{name}{RESULT.suffix}", inversion, overwrite=True)
    outputs = Outputs(overwrite=True)
    outputs.files += [result, *figures]
    outputs.write_figures(figures)
    rows = [("error", errors["Retrieved"]), ("error of Poisson", errors["Poisson"])]
    outputs.show("Demo", [*result_rows(inversion), *rows])
    outputs.exit_unless_sound(inversion, result)


def _error_text(estimate: FloatArray, truth: FloatArray) -> str:
    true_peak, peak = (float(np.hypot(*field).max()) for field in (truth, estimate))
    distance = float(np.linalg.norm(estimate - truth) / np.linalg.norm(truth))
    return f"peak {100 * (peak / true_peak - 1):+.1f} %, L2 {percent(distance)}"
