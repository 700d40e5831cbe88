"""One file per measurement: its residual, Jacobian, noise and source."""
