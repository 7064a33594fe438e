"""Grading submitted exercises."""
