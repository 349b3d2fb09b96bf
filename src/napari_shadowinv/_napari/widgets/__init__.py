"""The plugin's dock widgets.

- invert an image: `invert_shot`
- guess the undisturbed beam: `estimate_source`
- plan a shot: `forward_model`
- read values off a line: `line_profile`

Each widget is a thin face: `_jobs` and `_sampling` compute and know neither napari nor Qt,
`_forms` makes forms from the pydantic models, `_runner` keeps the window responsive.
"""
