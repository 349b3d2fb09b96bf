"""Semi-discrete optimal transport between a source and an image."""
