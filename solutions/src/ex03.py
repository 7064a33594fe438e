# %% [markdown]
# # Exercise 03 · Feasibility-Net
#
# **You will be able to** write the loss that trains a Feasibility-Net, and test whether what it
# predicts is true.
#
# About 35 minutes. Needs notebook 03, numpy, and no GPU.
#
# Write each function below its question, then run its `check`; `hint("ex03.q1")` gives one more
# hint at each call, and `solution("ex03.q1")` opens once the check has passed.

# %%
import numpy as np

from fgtutor.course.checks import check, hint, solution

# %% [markdown]
# ## ex03.q1
#
# One network predicts how well the policy will track ($f$), another one, a VAE, learns what terrain
# looks like. They are trained together (Eqs. 2-3):
#
# $$L = (f - r_v)^2 + \alpha\,L_{VAE}, \qquad L_{VAE} = L_{recon} + \beta\,L_{KL},$$
#
# with $\alpha = 1$ and $\beta = 5 \cdot 10^{-4}$ in the paper; here both are arguments. Every array
# holds one number a sample; the loss is the mean over the batch.


# %%
def feasibility_loss(f, r_v, recon, kl, alpha, beta):
    """Return the joint loss, a number."""
    # BEGIN SOLUTION
    vae = recon + beta * kl
    return np.mean((f - r_v) ** 2 + alpha * vae)
    # END SOLUTION


# %%
check("ex03.q1", feasibility_loss)

# %%
hint("ex03.q1")

# %% [markdown]
# ## ex03.q2
#
# The KL term keeps the latent near a standard normal, so that the autoencoder cannot simply
# memorise patches. For independent normals it has a closed form,
#
# $$L_{KL} = \tfrac12 \sum_j \left(\mu_j^2 + \sigma_j^2 - 1 - \log \sigma_j^2\right).$$
#
# The encoder gives `mean` and `log_variance`, both `[n, latent]`: any real number is a valid log
# variance, so nothing needs to be clipped.


# %%
def kl_divergence(mean, log_variance):
    """Return the KL divergence from N(0, 1) of every patch, [n]."""
    # BEGIN SOLUTION
    return 0.5 * (mean**2 + np.exp(log_variance) - 1 - log_variance).sum(axis=-1)
    # END SOLUTION


# %%
check("ex03.q2", kl_divergence)

# %% [markdown]
# ## ex03.q3
#
# Of all places where it predicted about 0.8, did the robot track with about 0.8? Cut [0, 1] into
# `bins` equal parts, and sort the samples into them **by prediction**. Row $b$ of the answer holds
# the mean prediction in part $b$, the mean measurement there, and how many samples it has. Drawn
# against each other, the first two columns are the calibration plot of notebook 03.
#
# A prediction of exactly 1 belongs to the last part. An empty part has no means: NaN (its count is
# 0).


# %%
def reliability(predicted, measured, bins):
    """Return [bins, 3]: mean predicted, mean measured, count."""
    # BEGIN SOLUTION
    index = np.minimum((predicted * bins).astype(int), bins - 1)
    table = np.full((bins, 3), np.nan)
    for b in range(bins):
        inside = index == b
        table[b, 2] = inside.sum()
        if inside.any():
            table[b, :2] = predicted[inside].mean(), measured[inside].mean()
    return table
    # END SOLUTION


# %%
check("ex03.q3", reliability)

# %% [markdown]
# ## ex03.q4
#
# Put the plot into one number: how far measured and predicted means lie apart, averaged over the
# parts, each part weighted by its count. `table` is what `reliability` returns, NaNs included.


# %%
def calibration_error(table):
    """Return the mean absolute calibration error, a number."""
    # BEGIN SOLUTION
    predicted, measured, count = table.T
    return np.nansum(np.abs(measured - predicted) * count) / count.sum()
    # END SOLUTION


# %%
check("ex03.q4", calibration_error)

# %% [markdown]
# ## What to try
#
# - A net that always answers the mean of all labels has an error of 0. Why is it useless all the
#   same? What else would you measure?

# %%
solution("ex03.q4")
