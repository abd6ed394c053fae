"""Expected information of a measurement, before there are data.

Computes the Fisher information from a circuit, a drive and channels with their noise; finds the directions that are
not identified, and the changes to the measurement that would identify them.
"""
