"""Numerical solvers: least squares, Gauss-Newton steps, Adam, Laplacian smoothing."""
