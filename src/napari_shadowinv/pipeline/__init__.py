"""From a shot to its result, for every face of the package."""
