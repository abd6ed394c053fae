"""Design of measurements and of drives.

Ranks changes to the measurement, and drive waveforms, for a scene with or without records.
"""
