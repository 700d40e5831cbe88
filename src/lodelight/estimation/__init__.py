"""Estimators: one pose against known points, poses and points together, poses against each other."""
