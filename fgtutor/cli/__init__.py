"""The commands beside training, evaluation and the course."""
