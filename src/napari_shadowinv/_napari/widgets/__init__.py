"""The plugin's dock widgets.

- invert an image: `invert_shot`
- invert a run of shots into a store: `invert_stack`
- guess the undisturbed beam: `estimate_source`
- plan a shot: `forward_model`
- read values off a line: `line_profile`

Each widget is a thin face: `_jobs`, `_stacking` and `_sampling` compute and know neither napari
nor Qt, `_forms` makes forms from the pydantic models, `_runner` keeps the window responsive.
"""
