"""The forward model fitted to images: what rays through potentials would make of them."""
