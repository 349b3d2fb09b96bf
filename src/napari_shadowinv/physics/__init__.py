"""What a deflection means in SI units, and how an image comes about."""
