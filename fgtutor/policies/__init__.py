"""Policy networks: how they are described, their symmetry, and the blind DreamWaQ policy."""
