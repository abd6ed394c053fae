"""Error for invalid input."""


class RecipeError(ValueError):
    """Scene, recipe or file that cannot be used; the message names the place and the remedy."""
