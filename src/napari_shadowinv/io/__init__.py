"""Files: radiographs in, results out."""
