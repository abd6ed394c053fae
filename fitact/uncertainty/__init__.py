"""How uncertain is each quantity, all sources of error together, and which source contributes how much?

Takes sensitivities, residuals and the distributions of errors. Gives budgets, effect sizes and rival explanations.
"""
