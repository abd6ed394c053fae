"""How uncertain is each quantity, all sources of error together, and how far can what the model lacks move it?

Takes sensitivities, distributions of errors, residuals and V(t). Gives budgets, the shift that structure in the
residuals could stand for, the causes that would explain it, and what no residual could reveal.
"""
