"""What is refused, in one sentence."""


class RecipeError(ValueError):
    """A scene, a recipe or a file that cannot be used; the sentence names place and remedy."""
