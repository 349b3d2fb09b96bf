"""The one way from a shot to its result, for every face of the package.

- apply a recipe to a shot: `run`; what a window keeps between runs: `Cache`
- the same in two parts, for stacks: `gathered`, `run_prepared`
- fit several images of one object by a recipe: `run_fit`, of `FitShot`; which fields explain
  them: `run_comparison`
- whether one static field explains them: `run_leave_one_out`; a film of fields: `run_windows`
- refine an inversion by a fit that starts from it: `run_refinement`
- recipes as files: `read_recipe`, `write_recipe`
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
