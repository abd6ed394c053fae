"""What did the user say?

Takes a scene file (TOML) or a dictionary; gives a checked `Scene` that makes the circuit, the drive and the prior.
"""
