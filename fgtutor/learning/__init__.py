"""Training: its settings, PPO with the Feasibility-Net, checkpoints, several processes."""

import fgtutor.io.rsl  # noqa: F401  (before its modules load rsl_rl themselves)
