"""Products: quantities computed from a retrieved field, each with its band.

- measure products of a result: `analyse`; each becomes a `ProductResult`
- values along a line or path: `LineProfile`; in a drawn region: `Region`
- line integrals: `Flux`, `EnclosedCurrent`, `EnclosedCharge`
- maps: `CurrentDensity`, `ChargeDensity`, `PhaseCurvature`
- how strongly the field structures the image: `Contrast`
- objects with an axis: `AxisymmetricProfile` from the side, `AzimuthalProfile` face-on
- turbulence: `TurbulenceSpectrum`
- all kinds: `PRODUCTS`; products of a table or a line of text: `product_from_dict`,
  `product_from_text`
- products in files and tables: `add_products`, `products_in`, `products_table`
- a product over successive shots: `analyse_shots` of a store
- add a product: a subclass of `Product`, in a module that `kinds` imports
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
