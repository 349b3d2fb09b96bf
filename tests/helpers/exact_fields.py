"""Exact fields of phantoms as results, with the setup of the paper."""

from __future__ import annotations

from napari_shadowinv.inversion.result import RetrievedField
from napari_shadowinv.inversion.variables import dataset_from_field
from napari_shadowinv.physics.phantoms import Phantom
from napari_shadowinv.physics.setup import ProtonSetup

SETUP = ProtonSetup.example()


def field_of(phantom: Phantom) -> RetrievedField:
    """Return the exact field of a phantom."""
    return RetrievedField(dataset_from_field(phantom.displacement, phantom.potential, SETUP))
