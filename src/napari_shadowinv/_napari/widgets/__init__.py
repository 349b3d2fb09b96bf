"""The dock widgets, thin faces of the pipeline and of stacks.

- invert an image: `invert_shot`; a run of shots into a store: `invert_stack`
- guess the undisturbed beam: `estimate_source`
- plan a shot: `forward_model`
- read values off a line: `line_profile`
"""
