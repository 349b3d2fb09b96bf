"""What is done to a shot before its inversion: filters, estimates of its source."""
