"""From a shot to its result by a recipe, for Python, commands and windows.

- apply a recipe to a shot: `run`; sites and sources that a window reuses: `Cache`
- fit several images of one object by a recipe: `run_fit`
- repeat a result from its provenance: module `rerun`
- an experiment before its shot, by simulated shots: `plan_experiment`, with `ExperimentOptions`
- recipes as files: `read_recipe`, `write_recipe`
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
