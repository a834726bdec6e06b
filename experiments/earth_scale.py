"""The globe with NASA's Blue Marble, to be painted at other scales.

flx train experiments/earth_scale.py --surface.path PATH/mesh.obj --surface.texture PATH/earth-blue-marble.jpg
flx sample runs/earth_scale --scale 2 --out runs/earth_scale/double

Scale itself is `flx sample --scale` on any run, this one or another: 2 makes details twice as large, on a
quarter of the vertices, and 0.5 half as large, on four times as many. Without training it is
flx sample PATH/mesh.obj --texture PATH/earth-blue-marble.jpg --instant --scale 2. The settings are the demo's
with fewer vertices: 6 minutes of training on two busy cores. Expect the same lands and seas in pieces, half
and twice as large (docs/gallery.md has the picture).
"""

from dataclasses import replace

from flx.config import Surface, quick

demo = quick(name="earth_scale")
config = replace(
    demo,
    surface=Surface(path="mesh.obj", texture="earth-blue-marble.jpg", vertices=3000, copies=8),
)
