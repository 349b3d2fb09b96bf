"""The plugin's dock widgets, each a thin face of what `_jobs` and `_stacking` compute.

- invert an image: `invert_shot`; a run of shots into a store: `invert_stack`
- guess the undisturbed beam: `estimate_source`
- plan a shot: `forward_model`
- read values off a line: `line_profile`
"""
