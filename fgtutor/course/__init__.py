"""The course: what its notebooks draw and drive, its exercises and their marks, its widgets."""
