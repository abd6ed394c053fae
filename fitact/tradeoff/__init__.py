"""Accuracy and run time of each method.

Measures the error and the run time of every method for a scene and a record, on this machine.
"""
