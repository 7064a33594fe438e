"""Training: its settings, PPO with the Feasibility-Net, checkpoints, several processes."""
