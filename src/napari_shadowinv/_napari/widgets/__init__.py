"""The docked widgets of the plugin; see `napari.yaml`."""
