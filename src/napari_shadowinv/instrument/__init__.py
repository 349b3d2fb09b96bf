"""Effects of an instrument that is not exact, and random changes of a beam."""
