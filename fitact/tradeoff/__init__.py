"""What does accuracy cost?

Takes a scene and a record; gives the error and the time of every method, measured on this machine.
"""
