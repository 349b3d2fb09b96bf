"""What `shadowinv forward` predicts: a field's image in its own or in another experiment."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, cast

from napari_shadowinv.cli._inputs import Field
from napari_shadowinv.cli._tables import setup_text
from napari_shadowinv.errors import InputError

if TYPE_CHECKING:
    from napari_shadowinv._typing import FloatArray
    from napari_shadowinv.physics.setup import Deflector, Setup


@dataclass(frozen=True)
class Prediction:
    """A field with the experiment that it is from, and the one that it is to be seen in."""

    displacement: FloatArray
    source: FloatArray | None
    made_with: Setup | None
    seen: Setup | None
    deflector: Deflector | None
    dispersion: float

    @property
    def is_elsewhere(self) -> bool:
        """Whether the experiment to predict is another one."""
        return self.made_with is not None and self.made_with != self.seen


def seen_with(
    field: Field, seen: Setup | None, told: Setup | None, deflector: str | None, dispersion: float
) -> Prediction:
    """Find out which experiments are meant."""
    if told is not None and field.setup is not None and told != field.setup:
        raise InputError(
            "received --made-with, but the field's file contains its own setup, "
            f"{setup_text(field.setup)}: leave it out"
        )
    made_with = field.setup if told is None else told
    meant = Prediction(
        displacement=field.displacement,
        source=field.source,
        made_with=made_with,
        seen=made_with if seen is None else seen,
        # Names of two words have a hyphen on the command line.
        deflector=cast("Deflector | None", deflector and deflector.replace("-", " ")),
        dispersion=dispersion,
    )
    if (deflector is not None or dispersion != 1) and not meant.is_elsewhere:
        raise InputError(
            "received --deflector or --dispersion, but only one setup: expected a different one "
            "with --setup, and for a field in px also --made-with"
        )
    # In another experiment the beam is another one, too.
    return replace(meant, source=None) if meant.is_elsewhere else meant


def predicted(meant: Prediction, source: FloatArray | None) -> tuple[FloatArray, str]:
    """Return the image, and in words what was assumed."""
    from napari_shadowinv.physics.forward import synthetic_image
    from napari_shadowinv.physics.projection import default_deflector, project

    if meant.made_with is None or meant.seen is None or not meant.is_elsewhere:
        return synthetic_image(meant.displacement, source), ""
    deflector = meant.deflector or default_deflector(meant.made_with, meant.seen)
    image = project(
        meant.displacement,
        meant.made_with,
        meant.seen,
        deflector=deflector,
        dispersion=meant.dispersion,
        source=source,
    )
    return image, (
        f"From {setup_text(meant.made_with)} to {setup_text(meant.seen)}, assuming that only a "
        f"{deflector} deflects the beam"
    )
