"""Loss functions and residuals of the training."""
