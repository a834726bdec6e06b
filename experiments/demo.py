"""A vase that flx paints itself, learnt at 5K vertices in about 11 minutes of two CPU cores.

  flx train experiments/demo.py && flx sample runs/demo --count 4
  flx train YOUR.glb && flx sample runs/YOUR --count 4             the same settings on your own mesh

The loss, 1 for an answer of zero, ends near 0.7.
"""

from flx.config import quick

config = quick()
