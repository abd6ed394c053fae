"""How far can what the model lacks move the answer?

Takes the residuals of a fit, V(t) at its samples, and the linearised posterior. Gives for each quantity the shift that
structure in the residuals could stand for, the causes that would explain it, and what no residual could reveal.
"""
