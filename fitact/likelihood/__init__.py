"""How probable is a record at given parameters?

Takes records, a circuit and a prior; gives the log-likelihood, summed over the samples or compressed to a few numbers
with a bound on the error.
"""
