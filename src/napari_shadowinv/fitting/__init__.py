"""The forward model fitted to images, by tracing rays through potentials.

- fit fields, and the beam, to one or several images of one object: `fit`, with `FitOptions`
- the answer: `Fit`, with a `facts.Verdict` on whether it may be believed
- the width of the point spread from the beam's source and the detector: `point_spread`
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
