"""Prior distributions of the parameters.

Makes distributions, and their joint density in log-parameters, from medians, factors and published tables.
"""
