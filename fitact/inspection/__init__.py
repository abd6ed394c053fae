"""Answers of `fitact inspect`: what was read, what is doubtful, and a preview of a file that could not be read."""
