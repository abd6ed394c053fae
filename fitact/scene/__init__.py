"""User's description of device, skin, drive and measurement.

Reads a scene file (TOML) or a dictionary into a checked `Scene`, which constructs circuit, drive and prior.
"""
