"""Physical model of the finger on the display.

Computes voltages, currents and forces from a circuit, a drive and times, by pure JAX functions without data.
"""
