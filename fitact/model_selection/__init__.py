"""Model selection for a scene or a record.

Computes the error and the speed-up of each simplification of a scene, and ranks alternative models of a record.
"""
