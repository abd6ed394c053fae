"""How do parameters, contact area and force change while a record runs?

Takes a long record (a file, a stream or arrays) and a scene; gives values with uncertainties over time (`Track`).
"""
