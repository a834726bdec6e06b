"""Stripes that follow a direction: a striped vase at 1,500 vertices, told which way is up.

python tests/reports/stripes.py make stripes.glb
flx train experiments/stripes_direction.py
flx sample runs/stripes_direction --rotate 90
python tests/reports/stripes.py measure runs/stripes_direction

The first line writes the demo's vase with stripes around it. The direction y runs up the vase, so they lie at
right angles to it. Turned by 90 degrees it runs around the vase, and the stripes should run up. The last line
measures how they lie.
"""

from dataclasses import replace

from flx.config import quick

demo = quick("stripes.glb", name="stripes_direction")
# Of the draws, a fifth sees no direction: guidance compares what the network says without it, too.
config = replace(
    demo,
    model=replace(demo.model, direction_dropout=0.2),
    surface=replace(demo.surface, direction="y", vertices=1500),
    train=replace(demo.train, steps=600),
)
