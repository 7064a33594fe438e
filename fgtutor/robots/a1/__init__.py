"""The Unitree A1 in MuJoCo."""
