"""How much model does the scene, or the record, need?

Takes a scene, with records or without; gives the error and the cost of every simplification, and ranks rival models.
"""
