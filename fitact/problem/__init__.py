"""Likelihood of records in a scene, and the point from which its fit starts.

Chooses the drive, the samples and the nuisances of each channel, and takes noise and first estimates from the records.
"""
