"""The parts of `paper.py`: shots, measurements, drawing, figures and the page."""
