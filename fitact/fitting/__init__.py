"""Least-squares fits, and whether they are reliable.

Fits records or a spectrum to a scene and returns a `Fit` with the optimum, its covariance, residual tests and a
verdict.
"""
