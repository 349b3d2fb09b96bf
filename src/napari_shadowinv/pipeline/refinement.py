"""An inversion refined by a fit that starts from its field: `run_refinement`."""

from __future__ import annotations

from dataclasses import replace

from napari_shadowinv._system.progress import OnProgress, ShouldStop
from napari_shadowinv.fitting import Fit, fit
from napari_shadowinv.inversion import Inversion
from napari_shadowinv.options import FitChoices, FitOptions
from napari_shadowinv.physics.setup import Setup
from napari_shadowinv.pipeline.fit_run import usual_fields
from napari_shadowinv.provenance import Provenance

__all__ = ["refinement_choices", "run_refinement"]


def run_refinement(
    inversion: Inversion,
    setup: Setup | None,
    choices: FitChoices,
    *,
    on_progress: OnProgress | None = None,
    should_stop: ShouldStop | None = None,
) -> Fit:
    """Fit the forward model to the image of an inversion, with its source and mask.

    Parameters
    ----------
    inversion : Inversion
        Its potential is one of the starts of the fit.
    setup : Setup or None
        The experiment, with the pixels of the inversion.
    choices : FitChoices
        Such as `refinement_choices`; the source is known, and so is the brightness.
    on_progress, should_stop : callable, optional
        As for `napari_shadowinv.fit`.

    Returns
    -------
    Fit
        With its `provenance` if the inversion has one.

    Raises
    ------
    InputError
        If the image cannot be fitted.
    InversionCancelled
        If `should_stop` returned true.
    """
    result = fit(
        inversion.image,
        setups=None if setup is None else [setup],
        fields=choices.fields or usual_fields(None if setup is None else [setup]),
        source=inversion.source,
        noise=choices.noise,
        psf=choices.psf or 0.0,
        mask=inversion.mask,
        start=inversion.potential,
        options=_options(inversion, choices.options),
        on_progress=on_progress,
        should_stop=should_stop,
    )
    if inversion.provenance is None:
        return result
    return replace(result, provenance=_provenance(inversion.provenance, setup, choices))


def _options(inversion: Inversion, options: FitOptions) -> FitOptions:
    """Return the options, with the beam's variation from the error budget of the inversion."""
    errors = inversion.errors
    if options.beam_variation is not None or errors is None or errors.beam is None:
        return options
    return options.model_copy(update={"beam_variation": errors.beam_variation})


def refinement_choices(inversion: Inversion, setup: Setup | None, psf: float = 0.0) -> FitChoices:
    """Return the choices that follow from an inversion: field, boundary and seed."""
    field = "B" if setup is None else setup.deflectors[0].key
    boundary = "free" if inversion.options.boundary == "free" else "fading"
    options = FitOptions(boundary=boundary, seed=inversion.options.seed)
    return FitChoices(fields=(field,), psf=psf, options=options)


def _provenance(start: Provenance, setup: Setup | None, choices: FitChoices) -> Provenance:
    recipe = start.recipe.model_copy(update={"setup": None, "fit": choices})
    image = start.image.model_copy(update={"mask": None, "source_mask": None, "setup": setup})
    return Provenance(kind="fit", recipe=recipe, images=(image,), start=start)
