"""Posterior sampling.

Draws from the posterior of a `Fit` by emcee until convergence, or by importance sampling around the optimum.
"""
