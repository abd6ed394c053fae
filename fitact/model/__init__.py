"""What happens on the display?

Takes a circuit, a drive and times; gives voltages, currents and forces. Pure JAX functions that know no data.
"""
