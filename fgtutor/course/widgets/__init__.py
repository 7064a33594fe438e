"""The live widgets of the notebooks."""
