"""Which parameters fit best, and may one trust them?

Takes records or a spectrum and a scene; gives a `Fit`: the optimum, its covariance, tests of the residuals and a
verdict.
"""
