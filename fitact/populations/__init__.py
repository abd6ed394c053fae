"""How do fingers differ, and what does the next one feel?

Takes records of several fingers; gives the distribution over fingers, its uncertainty, and what it predicts.
"""
