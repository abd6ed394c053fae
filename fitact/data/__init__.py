"""Checked records and spectra.

`Record`s and `Spectrum`s, with warnings on possible errors, and simulated records.
"""
