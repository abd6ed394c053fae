"""What the data say: least squares, identifiability, and posteriors by emcee."""
