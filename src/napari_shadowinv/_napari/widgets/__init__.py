"""The dock widgets, thin faces of the pipeline and of stacks; see `napari.yaml`."""
