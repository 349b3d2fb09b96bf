"""The public comparison of solvers: images with known truth, one environment a solver, one page."""
