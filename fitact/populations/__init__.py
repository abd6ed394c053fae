"""Variability between fingers, and predictions for a new finger.

Estimates the distribution over fingers, its uncertainty and its predictions from records of several fingers.
"""
