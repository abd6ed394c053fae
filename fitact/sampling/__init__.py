"""What is the posterior?

Takes a `Fit`; gives draws by emcee until they have converged, or weighted draws around the optimum.
"""
