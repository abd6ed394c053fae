"""Likelihood of records at given parameters.

Computes the log-likelihood from records, a circuit and a prior, summed over the samples or compressed to a few
numbers with a verified error.
"""
