"""Where the parts of a result come from, for its layers, its file and the report: `Origins`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

__all__ = ["Origins"]


@dataclass(frozen=True)
class Origins:
    """What an inversion was given, in words.

    Attributes
    ----------
    image : str
        The image, or the images.
    source, setup : str
        Where they come from.
    mask, source_mask : str
        Likewise; empty if there is none.
    setup_origin : str
        As `napari_shadowinv._napari.layer_metadata.setup_origin_of` tells it; empty for no setup.
    """

    image: str
    source: str
    mask: str
    source_mask: str
    setup: str
    setup_origin: str

    @classmethod
    def of(cls, tool: Any, layer: Any, name: str) -> Origins:
        """Ask the controls of a widget, for an image or the images of that name."""
        return cls(
            name,
            tool.source.described,
            tool.masks.described(layer),
            tool.source_masks.described(layer) if tool.source.is_guessed else "",
            tool.setup.described,
            tool.setup.origin,
        )

    def attributes(self) -> dict[str, str]:
        """What a result keeps of it, beside the names of files."""
        told = {
            "source_origin": self.source,
            "mask_origin": self.mask,
            "source_mask_origin": self.source_mask,
            "setup_origin": self.setup_origin,
        }
        return {name: text for name, text in told.items() if text}

    def rows(self) -> list[tuple[str, str]]:
        """What a report tells of it, in two columns of text."""
        told = [
            ("Image", self.image),
            ("Source", self.source),
            ("Source mask", self.source_mask),
            ("Mask", self.mask),
            ("Setup", self.setup),
        ]
        return [(name, text) for name, text in told if text]
