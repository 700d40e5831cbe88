"""A simulated building to drive through: rendered recordings with exact truth.

from lodelight.sim.scenarios import simulate
simulate("office", out="office", seed=0, duration_s=10)
"""
