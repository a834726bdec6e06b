"""A scanned bowl (Google Scanned Objects, Now_Designs_Bowl_Akita_Black) at 10,000 vertices.

flx train experiments/bowl.py --surface.path PATH/akita_black_bowl.obj
flx sample runs/bowl --count 4

On two CPU cores a step takes 0.8 to 1.3 s, and the whole training took 23 minutes. Expect whole spirals; with
`flx sample --height z` the rim stays a rim (docs/gallery.md).
"""

from dataclasses import replace

from flx.config import Surface, quick

demo = quick(name="bowl")
config = replace(
    demo,
    surface=Surface(path="akita_black_bowl.obj", vertices=10_000, copies=8, up="z"),
)
