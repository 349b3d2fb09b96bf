"""The command `forward`: the image that an object casts."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Option

from napari_shadowinv.cli import _flags
from napari_shadowinv.cli._inputs import read_setup
from napari_shadowinv.cli._objects import HELP, file_of, object_of
from napari_shadowinv.cli._outputs import Outputs
from napari_shadowinv.cli._settings import Sections, settings_of
from napari_shadowinv.cli._summary import Rows, fact_rows, setup_text, size_text
from napari_shadowinv.cli._terminal import notify_errors, work_callbacks
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import percent
from napari_shadowinv.io.formats import IMAGE_WRITERS, TIFF
from napari_shadowinv.physics.trace_options import SizedView, TraceOptions

SECTIONS: Sections = {"view": SizedView, "trace": TraceOptions}
EPILOG = """
shadowinv forward shot.shadowinv --setup lower.toml --deflector plasma

shadowinv forward fields.h5 --setup setup.toml --set view.beam=x

Causes: magnetic-field, electric-field, plasma, refractive-index.
"""


@notify_errors
@_flags.takes_flags
def forward(
    object: Annotated[str, _flags.argument(help=HELP)],
    outputs: Outputs,
    setup: _flags.SetupFile = None,
    deflector: _flags.Deflector = None,
    source: _flags.SourceFile = None,
    channel: _flags.Channel = None,
    settings: Annotated[list[str] | None, _flags.setting(SECTIONS, "trace.output=counts")] = None,
    out: Annotated[Path | None, Option(help="Image: .tif, .npy or .png.")] = None,
) -> None:
    """Predict the image of a result, a 3-D field or a phantom, for any setup.

    The source is the result's own if the setup is the same, else uniform.
    """
    from napari_shadowinv.io import read_shot, write
    from napari_shadowinv.pipeline.prediction import predict

    file = file_of(object)
    stem = object.partition(":")[0] if file is None else file.stem
    path = Path(f"{stem}_image{TIFF.suffix}") if out is None else out
    outputs.check([(path, tuple(IMAGE_WRITERS))], [file, source, setup])
    chosen = settings_of(settings or (), SECTIONS, {})
    view = chosen.change("view", SizedView())
    experiment = read_setup(setup)
    outputs.warn_of_setups([(experiment, None)])
    beam = None
    if source is not None:
        beam = read_shot(source, channel=channel).image
        if {"view.height", "view.width"} & chosen.values.keys():
            raise InputError(
                "received view.height or view.width, but --source sets the size: leave it out"
            )
    target = object_of(object, deflector, chosen, view)
    original = getattr(target, "setup", None)
    if deflector is not None and (experiment is None or original in (None, experiment)):
        raise InputError(
            "received --deflector, but only one setup: expected a different one with --setup"
        )
    with work_callbacks(outputs.quiet) as callbacks:
        prediction = predict(
            target,
            experiment,
            (view.height, view.width),
            source=beam,
            deflector=deflector,
            options=chosen.change("trace", TraceOptions()),
            **callbacks,
        )
    traced, image = prediction.traced, prediction.image
    write(path, image, setup=prediction.setup, overwrite=outputs.overwrite)
    rows: Rows = [("setup", setup_text(prediction.setup, shape=image.shape))]
    if traced is not None:
        rows += fact_rows(traced.facts)
    else:
        rows += [("warning", prediction.warning)] if prediction.warning else []
        rows.append(("flux", f"{percent(prediction.inside)} lands inside the image"))
    outputs.show(size_text(image.shape), rows)
