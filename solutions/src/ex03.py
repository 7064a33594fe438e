# %% [markdown]
# # Exercise 03 · Feasibility-Net
#
# **You will be able to** build the Feasibility-Net in PyTorch, write its loss, make labels from a
# rollout, train a net, and test whether what it predicts is true.
#
# About 90 minutes. Needs [notebook 03](../notebooks/03_feasibility_net.ipynb),
# numpy and PyTorch, and no GPU. You may import
# what [exercise 01](ex01.ipynb) lists.
#
# Write each answer below its question, then run its `check`; `hint("ex03.q1")` gives one more hint
# at each call, and `solution("ex03.q1")` opens once the check has passed.

# %%
import numpy as np
import torch
from torch import nn

from fgtutor.course.checks import check, hint, solution, with_mine

# %% [markdown]
# ## ex03.q1
#
# The Feasibility-Net (paper, Fig. 2) is two nets that share no weight. The **head** reads a patch
# and a command and predicts how well the policy will track, $f \in [0, 1]$. The **autoencoder**
# reads the patch alone: the encoder gives the mean and the log variance of a latent, the decoder
# makes a patch from a latent. Write the class with three members, in this order, each an
# `nn.Sequential` of a linear layer, an activation, and a linear layer:
#
# | member | from | to | activation |
# |---|---|---|---|
# | `head` | points + command | 1 | `nn.ELU` |
# | `encoder` | points | 2 latent | `nn.Tanh` |
# | `decoder` | latent | points | `nn.Tanh` |
#
# all with `hidden` numbers between the layers. And two methods:
#
# - `feasibility(patch, command)` returns f `[n]`: the sigmoid of the head's answer.
# - `reconstruction(patch)` returns $L_{recon}$ `[n]`: the latent **mean** is decoded (no noise),
#   and the squared error is **summed** over the patch.
#
# Heights come in metres. Head and autoencoder both work with `4 * patch`, so that a unit is a tall
# step; the squared error is in these units too. The first half of the encoder's answer is the mean,
# the second half the log variance.


# %%
class FeasibilityNet(nn.Module):
    """Predicts f of a patch [n, points] and a command [n, command], and L_recon of a patch."""

    def __init__(self, points, command, hidden, latent):
        super().__init__()
        # BEGIN SOLUTION
        self.head = nn.Sequential(
            nn.Linear(points + command, hidden), nn.ELU(), nn.Linear(hidden, 1)
        )
        self.encoder = nn.Sequential(
            nn.Linear(points, hidden), nn.Tanh(), nn.Linear(hidden, 2 * latent)
        )
        self.decoder = nn.Sequential(
            nn.Linear(latent, hidden), nn.Tanh(), nn.Linear(hidden, points)
        )

    def feasibility(self, patch, command):
        """Return f [n], in [0, 1]."""
        score = self.head(torch.cat((4 * patch, command), dim=-1))
        return torch.sigmoid(score).squeeze(-1)

    def reconstruction(self, patch):
        """Return L_recon [n]."""
        heights = 4 * patch
        mean, _ = self.encoder(heights).chunk(2, dim=-1)
        return ((self.decoder(mean) - heights) ** 2).sum(dim=-1)
        # END SOLUTION


# %%
check("ex03.q1", FeasibilityNet)

# %%
hint("ex03.q1")

# %% [markdown]
# ## ex03.q2
#
# Both parts are trained together (Eqs. 2 and 3):
#
# $$L = (f - r_v)^2 + \alpha\,(L_{recon} + \beta\,L_{KL}),$$
#
# the mean over the batch. In training the decoded latent is not the mean but a sample,
# $z = \mu + \sigma\,\epsilon$, and the `noise` $\epsilon$ is given (so that gradients pass through
# $\mu$ and $\sigma$: the reparametrisation). The divergence from a standard normal is
#
# $$L_{KL} = \tfrac12 \sum_j \left(\mu_j^2 + \sigma_j^2 - 1 - \log \sigma_j^2\right).$$
#
# `net` has `encoder`, `decoder` and `feasibility` as in question 1, and again heights count times
# 4. The encoder gives $\log \sigma^2$. Return a tensor of one number; the check calls its
#    `backward()`
# and looks at the gradient of every weight.


# %%
def joint_loss(net, patch, command, r_v, noise, alpha, beta):
    """Return the joint loss, a scalar tensor; noise is [n, latent]."""
    # BEGIN SOLUTION
    heights = 4 * patch
    mean, log_variance = net.encoder(heights).chunk(2, dim=-1)
    latent = mean + torch.exp(0.5 * log_variance) * noise
    decoded = net.decoder(latent)
    recon = ((decoded - heights) ** 2).sum(dim=-1)
    variance = torch.exp(log_variance)
    kl = 0.5 * (mean**2 + variance - 1 - log_variance).sum(dim=-1)
    f = net.feasibility(patch, command)
    error = (f - r_v) ** 2
    vae = recon + beta * kl
    return (error + alpha * vae).mean()
    # END SOLUTION


# %%
check("ex03.q2", joint_loss)

# %% [markdown]
# ## ex03.q3
#
# Of all places where it predicted about 0.8, did the robot track with about 0.8? Cut [0, 1] into
# `bins` equal parts, and sort the samples into them **by prediction**. Row $b$ of the table holds
# the mean prediction in part $b$, the mean measurement there, and the number of samples. Drawn
# against each other, the first two columns are the calibration plot of notebook 03. A prediction of
# exactly 1 belongs to the last part. An empty part has no means: NaN (and a count of 0).
#
# Then put the plot into one number: the distance between measured and predicted means, averaged
# over the parts, each part weighted by its count. Return the table and this error.


# %%
def reliability(predicted, measured, bins):
    """Return the table [bins, 3] (mean predicted, mean measured, count) and the error."""
    # BEGIN SOLUTION
    index = np.minimum((predicted * bins).astype(int), bins - 1)
    table = np.full((bins, 3), np.nan)
    for b in range(bins):
        inside = index == b
        table[b, 2] = inside.sum()
        if inside.any():
            table[b, 0] = predicted[inside].mean()
            table[b, 1] = measured[inside].mean()
    means, outcomes, counts = table.T
    gaps = np.abs(outcomes - means)
    error = np.nansum(gaps * counts) / counts.sum()
    return table, error
    # END SOLUTION


# %%
check("ex03.q3", reliability)

# %% [markdown]
# ## ex03.q4
#
# In exercise 02 a rollout was one robot and one episode. Now make labels from a real one, `[T, n]`:
# $n$ robots, each with several episodes. `ended` marks the last step of an episode, and `failed`
# those last steps in which the robot fell; other ends are time-outs.
#
# The label of a step is the mean of `r_v` over the next `window` steps, from the step itself on,
# and never reaches into the next episode. If a **fall** ends the window early, the steps that never
# happened count as zeros: divide by `window`. If a **time-out** or the end of the rollout ends it
# early, they do not count: divide by the steps that there were. (As in ex02.q2, `r_v[t]` is what
# step $t$ itself earned. In notebook 03 row $t$ tells of the step before it, so there the mean
# begins one row later.)
#
# Some labels stand on too little. A label is `trusted` if its window ends with a fall, or if at
# least half of the window was seen.


# %%
def rollout_labels(r_v, failed, ended, window):
    """Return (labels, trusted), both [T, n]."""
    # BEGIN SOLUTION
    steps, robots = r_v.shape
    labels, trusted = np.zeros((steps, robots)), np.zeros((steps, robots), dtype=bool)
    for robot in range(robots):
        for t in range(steps):
            total, seen, fell = 0.0, 0, False
            for later in range(t, min(t + window, steps)):
                total += r_v[later, robot]
                seen += 1
                if ended[later, robot]:
                    fell = failed[later, robot]
                    break
            labels[t, robot] = total / (window if fell else seen)
            trusted[t, robot] = fell or seen >= window / 2
    return labels, trusted
    # END SOLUTION


# %%
check("ex03.q4", rollout_labels)

# %% [markdown]
# ## ex03.q5
#
# Train. `net` maps patches `[n, points]` to f `[n]`; `patch` and `r_v` are there to learn from,
# `held_patch` and `held_r_v` only to look whether it has learned: no update may see them. Make at
# most `most` updates with an optimizer of your choice. At the end, on the held-out data,
#
# - the calibration error of question 3, with 5 parts, must be at most `goal`, and
# - the mean squared error at most a quarter of the variance of `held_r_v`: a net that answers the
#   mean for everything is calibrated, and useless.
#
# Return how many updates there were, and the calibration error at the end. Each pass through the
# net with gradients counts as an update; so look at the held-out data under `torch.no_grad()`.


# %%
def train(net, patch, r_v, held_patch, held_r_v, goal, most):
    """Train the net in place; return (updates, calibration error on the held-out data)."""
    # BEGIN SOLUTION
    optimizer = torch.optim.Adam(net.parameters(), lr=0.05)
    measured = held_r_v.numpy()
    for update in range(1, most + 1):
        loss = ((net(patch) - r_v) ** 2).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if update % 10 == 0 or update == most:
            with torch.no_grad():
                f = net(held_patch).numpy()
            _, error = reliability(f, measured, 5)
            spread = ((f - measured) ** 2).mean() / measured.var()
            if error <= goal and spread <= 0.25:
                break
    return update, error
    # END SOLUTION


# %%
check("ex03.q5", train)

# %% [markdown]
# ## Your own planner
#
# What has passed is kept in `mine.py`, beside this notebook. Here the planner runs with your
# functions in place of the library's, and the lines above the picture say which stages are yours.
# The first run takes some ten seconds or more: it loads torch and the specialists.

# %%
with_mine("ex03")

# %% [markdown]
# ## What to try
#
# - Train once with `goal` met on the training data instead. How far off is it on the held-out data?
# - Leave the `spread` condition out, and start from a net whose last bias is the mean of all
#   labels.

# %%
solution("ex03.q4")
